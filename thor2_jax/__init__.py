"""THOR2 (Samani and Banerjee, 2024) in JAX: coloured point clouds to TOPS and TOPS2, RGB-D frames to object names."""

import thor2_jax.jax_version  # noqa: F401  first: it refuses versions of jax that give wrong numbers
from thor2_jax.config import DESCRIPTOR_VERSION, DescriptorConfig, Relaxation
from thor2_jax.descriptor.describe import describe, describe_aligned, describe_strips, diagrams, strips
from thor2_jax.descriptor.view_normalization import align, mirror, turn, view_normalize
from thor2_jax.errors import InputError
from thor2_jax.parameters import Parameters
from thor2_jax.recognition.frames import Intrinsics, RGBDFrame, read_frame
from thor2_jax.recognition.recognizer import Recognition, Recognizer
from thor2_jax.types import Descriptors, Diagrams, PointClouds, Strips

__all__ = [
    "DESCRIPTOR_VERSION",
    "DescriptorConfig",
    "Descriptors",
    "Diagrams",
    "InputError",
    "Intrinsics",
    "Parameters",
    "PointClouds",
    "RGBDFrame",
    "Recognition",
    "Recognizer",
    "Relaxation",
    "Strips",
    "align",
    "describe",
    "describe_aligned",
    "describe_strips",
    "diagrams",
    "mirror",
    "read_frame",
    "strips",
    "turn",
    "view_normalize",
]
