"""Prediction of road users over the next seconds, by drivers of the simulator on the lanes ahead of them."""
