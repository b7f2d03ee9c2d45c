"""Computation of descriptors from point clouds: view normalization, slicing, colour, persistence, images."""
