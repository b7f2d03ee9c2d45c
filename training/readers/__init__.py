"""Datasets of labelled RGB-D frames, read one frame at a time."""
