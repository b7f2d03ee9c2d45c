"""Camera frames: image files, intrinsics, frames, and the clouds of their instances."""
