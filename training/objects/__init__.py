"""Objects to train on: meshes from files, and the built-in objects."""
