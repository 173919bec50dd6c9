"""Pages, diagrams and pictures."""
