"""Fitting classifiers to views: samples, steps, folds, checkpoints, calibration and the training job."""
