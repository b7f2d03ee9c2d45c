"""Fitting classifiers to views: samples, steps, folds, checkpoints, calibration, the training job."""
