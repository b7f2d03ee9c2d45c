"""The image networks by name: their architecture, image size and files of pretrained weights."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from training.baselines.networks.densenet import DENSENET_161, ViTCNN
from training.baselines.networks.resnet import RCFusion
from training.baselines.networks.vit import VIT_BASE, VIT_TINY_4, RGBDViT

__all__ = ["ARCHITECTURES", "Architecture", "network_inputs"]


@dataclasses.dataclass(frozen=True)
class Architecture:
    """An image network.

    Attributes:
        create: function of the number of classes and `rngs` that returns the network.
        size: side of its images, pixels.
        weights: backbone, an attribute of the network -> file of its pretrained weights, without the suffix; backbones
            without a public file are not listed.
    """

    create: Callable[..., Any]
    size: int
    weights: Mapping[str, str]

    def build(self, n_classes: int, seed: int) -> nnx.Module:
        """Return the network with random weights."""
        network: nnx.Module = self.create(n_classes, rngs=nnx.Rngs(seed))
        return network

    def backbones(self, network: Any) -> list[tuple[nnx.Module, str]]:
        """Return the backbones of a network with their files."""
        return [(getattr(network, backbone), file) for backbone, file in self.weights.items()]


_LARGE, _SMALL = 224, 96
_SMALL_DENSENET = {"growth": 12, "blocks": (2, 4, 4, 2)}
_TINY = "vit_tiny_patch16_224"

ARCHITECTURES: dict[str, Architecture] = {
    "rcfusion": Architecture(
        partial(RCFusion, width=64, projection=512, memory=50), _LARGE, {"color": "resnet18", "normals": "resnet18"}
    ),
    "rcfusion-small": Architecture(partial(RCFusion, width=16, projection=64, memory=50), _SMALL, {}),
    "vit-cnn": Architecture(
        partial(ViTCNN, vit=VIT_BASE, cnn=DENSENET_161, size=_LARGE),
        _LARGE,
        {"vit": "vit_base_patch16_224.mae", "cnn": "densenet161"},
    ),
    "vit-cnn-small": Architecture(
        partial(ViTCNN, vit=VIT_TINY_4, cnn=_SMALL_DENSENET, size=_SMALL), _SMALL, {"vit": _TINY}
    ),
    "rgbd-vit": Architecture(
        partial(RGBDViT, vit=VIT_BASE, size=_LARGE),
        _LARGE,
        {"color": "vit_base_patch16_224", "normals": "vit_base_patch16_224"},
    ),
    "rgbd-vit-small": Architecture(
        partial(RGBDViT, vit=VIT_TINY_4, size=_SMALL), _SMALL, {"color": _TINY, "normals": _TINY}
    ),
}
"""Name of the baseline -> its network."""


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
