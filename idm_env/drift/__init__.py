"""Drivers who drift: how much and for how long, which of their numbers, and forecasts that follow it."""
