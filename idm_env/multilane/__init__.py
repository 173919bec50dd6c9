"""What several lanes need of a step: trips that enter and leave, incentives, and changes of lane."""
