"""Tracks: the instances of one object in several frames, and the fused answer for the object."""
