"""Synthetic views of meshes, training, evaluation and the command line."""
