"""Fitting classifiers to views: samples, the training loop with its checkpoints, and calibration."""
