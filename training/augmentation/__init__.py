"""Augmented copies of training views: light, depth sensor, occlusion and segmentation errors."""
