"""Inputs of the image networks: crops, scaled as for the public weights."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["network_inputs"]

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
"""Mean and standard deviation of the colours of ImageNet, in [0, 1]."""


def network_inputs(color: Any, normals: Any) -> tuple[jax.Array, jax.Array]:
    """Return network inputs [B, S, S, 3] of colour and of normals for the arrays of `ViewCrops`.

    Normals are colour-coded, (n + 1) / 2. The background is 0 in both, the mean colour of ImageNet.
    """
    mask = jnp.any(normals != 0, axis=-1, keepdims=True)
    images = color.astype(jnp.float32) / 255, (normals.astype(jnp.float32) / 127 + 1) / 2
    first, second = (jnp.where(mask, (image - MEAN) / DEVIATION, 0) for image in images)
    return first, second
