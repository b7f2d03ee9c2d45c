"""Table of the image networks with which THOR2 is compared: architecture, image size and pretrained weights.

Weights of backbones are read from local safetensors files of PyTorch models:

    load_backbone(network.color, Path("weights/resnet18.safetensors"))

The files have the tensor names of timm: `layer1.0.conv1.weight` is the kernel of `model.layer1[0].conv1`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError, decoding
from thor2_jax.files import file_digest
from training.baselines.cnn import DENSENET_161, RCFusion, ViTCNN
from training.baselines.vit import VIT_BASE, VIT_DINOV2_SMALL, VIT_TINY_4, RGBDViT, ViT

__all__ = ["ARCHITECTURES", "TEMPLATES", "check_weights", "crop_size", "network_inputs", "pretrained_files"]

_TENSORS = {"kernel": "weight", "scale": "weight", "mean": "running_mean", "var": "running_var"}
"""Last part of an NNX path -> last part of the tensor's name."""


def tensors(model: nnx.Module) -> Iterator[tuple[str, tuple[int, ...], str, Any]]:
    """Yield the tensors of a backbone's file: name, shape, and the last name and the variable in the network.

    The last two axes of kernels are the first ones of the tensor, reversed.
    """
    prefix: str = getattr(model, "PREFIX", "")
    for path, variable in nnx.to_flat_state(nnx.state(model, (nnx.Param, nnx.BatchStat))):
        *modules, kind = map(str, path)
        shape = variable.shape
        if kind == "kernel":
            shape = (shape[-1], shape[-2], *shape[:-2])
        yield prefix + ".".join([*modules, _TENSORS.get(kind, kind)]), shape, kind, variable


def load_backbone(model: nnx.Module, path: Path) -> None:
    """Replace the weights of a backbone by weights from a file, ignoring other tensors in the file.

    The positions of a ViT are resampled to the grid of the model.

    Raises:
        InputError: the file is missing or damaged, or a tensor is missing or has another shape.
    """
    parameters, advice = list(tensors(model)), "give the file of the network's backbone"
    with decoding(f"weights: {path} cannot be read", "a safetensors file, see docs/baselines.md"):
        with safetensors.safe_open(path, "numpy") as file:
            wanted_names = {name for name, *_ in parameters}.intersection(file.keys())
            arrays = {name: file.get_tensor(name).astype(np.float32) for name in wanted_names}
    for name, wanted, kind, variable in parameters:
        if name not in arrays:
            raise InputError(f"weights: {path} has no tensor {name}; expected one of shape {wanted}: {advice}")
        array = resampled_positions(arrays[name], wanted) if kind == "pos_embed" else arrays[name]
        if array.shape != wanted:
            raise InputError(f"weights: {name} in {path} has the shape {array.shape}; expected {wanted}: {advice}")
        axes = (*range(2, array.ndim), 1, 0) if kind == "kernel" else range(array.ndim)
        variable.set_value(jnp.asarray(array.transpose(*axes)))


def resampled_positions(positions: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Resample the positions [1, 1 + G*G, D] of a ViT to another square grid, with bicubic interpolation as in timm.

    Positions of another length D, or of a grid that is not square, are returned unchanged.
    """
    sides = [round((n - 1) ** 0.5) for n in (positions.shape[1], shape[1])] if positions.ndim == 3 else [0, 0]
    square = positions.ndim == 3 and sides[0] ** 2 + 1 == positions.shape[1]
    if positions.shape == shape or not square or positions.shape[2] != shape[2]:
        return positions
    grid = positions[0, 1:].reshape(sides[0], sides[0], -1)
    resized = jax.image.resize(grid, (sides[1], sides[1], grid.shape[2]), "cubic")
    return np.concatenate([positions[0, :1], np.asarray(resized).reshape(sides[1] ** 2, -1)])[None]


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

    def build(self, n_classes: int, seed: int) -> Any:
        """Return the network with random weights."""
        return self.create(n_classes, rngs=nnx.Rngs(seed))

    def load_weights(self, network: Any, directory: Path) -> dict[str, str]:
        """Replace the weights of the backbones of a network by weights from the files in a folder.

        Returns:
            Name of each file -> its SHA-256.

        Raises:
            InputError: a file does not exist; also as `load_backbone`.
        """
        digests = {}
        for backbone, name in self.weights.items():
            path = directory / f"{name}.safetensors"
            if not path.is_file():
                raise InputError(f"weights: {path} does not exist; expected it in the folder, see docs/baselines.md")
            load_backbone(getattr(network, backbone), path)
            digests[path.name] = file_digest(path)
        return digests


TEMPLATES = "templates"
"""The nearest template by features of a frozen backbone, which may be the backbone of a network of the same run."""


def _dinov2(n_classes: int, *, rngs: nnx.Rngs) -> Any:
    return nnx.Dict(color=ViT(VIT_DINOV2_SMALL, _LARGE, rngs=rngs))


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
    TEMPLATES: Architecture(_dinov2, _LARGE, {"color": "vit_small_patch14_dinov2"}),
}
"""Name of the baseline -> its network; for the templates, the backbone that is read from a file of weights."""


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


def pretrained_files(name: str) -> list[str]:
    """Return the files of pretrained weights that a baseline reads, without the suffix; most baselines read none."""
    return sorted(set(ARCHITECTURES[name].weights.values())) if name in ARCHITECTURES else []


def crop_size(names: Sequence[str], weights: bool) -> int | None:
    """Return the largest side in pixels of the crops on which baselines are trained; None if they need no crops.

    Args:
        names: names of the baselines.
        weights: whether there are pretrained weights; templates then use DINOv2, which reads large crops.
    """
    readers = (name if weights or name != TEMPLATES else "rgbd-vit-small" for name in names)
    return max((ARCHITECTURES[name].size for name in readers if name in ARCHITECTURES), default=None)


def check_weights(directory: Path, name: str) -> dict[str, str]:
    """Read the files of a baseline's pretrained weights, without keeping them.

    Returns:
        Name of each file -> its SHA-256; empty for baselines that read none.

    Raises:
        InputError: a file is missing, damaged or of another architecture.
    """
    if not pretrained_files(name):
        return {}
    architecture = ARCHITECTURES[name]
    return architecture.load_weights(nnx.eval_shape(lambda: architecture.build(2, 0)), directory)
