"""Synthetic views of meshes, datasets of them, fitting, evaluation, and the command line."""
