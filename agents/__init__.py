"""Agents for the tasks, one readable file per algorithm; run from the checkout: ``python -m agents.apg --help``."""
