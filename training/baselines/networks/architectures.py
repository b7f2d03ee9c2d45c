"""The image networks by name: their architecture, image size and files of pretrained weights."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from flax import nnx

from training.baselines.networks.densenet import DENSENET_161
from training.baselines.networks.rcfusion import RCFusion
from training.baselines.networks.rgbd_vit import RGBDViT
from training.baselines.networks.vit import VIT_BASE, VIT_TINY_4
from training.baselines.networks.vit_cnn import ViTCNN

__all__ = ["ARCHITECTURES", "Architecture"]


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


_LARGE, _SMALL = 224, 96
_SMALL_DENSENET = {"growth": 12, "blocks": (2, 4, 4, 2)}
_TINY = "vit_tiny_patch16_224"

ARCHITECTURES: dict[str, Architecture] = {
    "rcfusion": Architecture(
        partial(RCFusion, width=64, projection=512, memory=50),
        _LARGE,
        {"color": "resnet18", "normals": "resnet18"},
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
