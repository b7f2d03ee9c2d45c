"""Training views: normalized point clouds and crops of meshes and labelled instances, in memory and on disk."""
