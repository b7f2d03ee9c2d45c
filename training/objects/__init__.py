"""Objects to train on: mesh files, built-in objects and procedural objects."""
