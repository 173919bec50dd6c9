"""Loops over measured records: a driver behind a measured leader, filters and smoothers of a track."""
