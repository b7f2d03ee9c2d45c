"""Frames of a camera: images, intrinsics, frames, and the clouds of their instances."""
