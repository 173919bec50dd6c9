"""Faces of the tasks: Gymnasium, PettingZoo and Stable-Baselines3; importing this package imports none of them."""
