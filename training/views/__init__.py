"""Training views: normalized point clouds of rendered meshes, in memory and on disk."""
