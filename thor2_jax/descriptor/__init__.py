"""From point clouds to descriptors: view normalization, slicing, colour, persistence, images."""
