"""Objects to train on: mesh files and built-in objects."""
