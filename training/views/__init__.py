"""Training views: point clouds of rendered meshes, normalized, in memory and on disk."""
