"""Pretrained weights of the networks' backbones, from local safetensors files of PyTorch models.

    load_backbone(network.color, Path("weights/resnet18.safetensors"))

The files are those of timm: a tensor `layer1.0.conv1.weight` is the kernel of `model.layer1[0].conv1`.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax.numpy as jnp
import numpy as np
import safetensors
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import open_file

__all__ = ["load_backbone", "load_weights", "resampled_positions", "tensor_shapes", "weights_file"]

_TENSORS = {"kernel": "weight", "scale": "weight", "mean": "running_mean", "var": "running_var"}
"""Last part of an NNX path -> of the tensor's name."""


def _state(model: nnx.Module) -> tuple[Any, dict[tuple[Any, ...], Any]]:
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return state, dict(flax.traverse_util.flatten_dict(nnx.to_pure_dict(state)))


def _tensor_name(path: tuple[Any, ...], prefix: str) -> str:
    return prefix + ".".join(map(str, (*path[:-1], _TENSORS.get(path[-1], path[-1]))))


def _torch_shape(shape: tuple[int, ...], kind: str) -> tuple[int, ...]:
    """Return the shape of a PyTorch tensor: kernels have their last two axes in front, reversed."""
    return (shape[-1], shape[-2], *shape[:-2]) if kind == "kernel" else shape


def tensor_shapes(model: nnx.Module) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the tensors of a backbone's file."""
    prefix = getattr(model, "PREFIX", "")
    return {_tensor_name(path, prefix): _torch_shape(value.shape, path[-1]) for path, value in _state(model)[1].items()}


def weights_file(directory: Path, name: str) -> Path:
    """Return the file of a backbone's pretrained weights.

    Raises:
        InputError: it does not exist.
    """
    path = directory / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"weights: {path} does not exist; expected it in the directory, see docs/baselines.md")
    return path


def load_weights(directory: Path, backbones: Iterable[tuple[nnx.Module, str]]) -> list[Path]:
    """Replace the weights of backbones by those of files in a directory, given without the suffix; return the files.

    Raises:
        InputError: a file does not exist, or as `load_backbone`.
    """
    paths = []
    for model, name in backbones:
        paths.append(weights_file(directory, name))
        load_backbone(model, paths[-1])
    return paths


def load_backbone(model: nnx.Module, path: Path) -> None:
    """Replace the weights of a backbone by those of a file; other tensors of the file are ignored.

    The positions of a ViT are resampled to the grid of the model.

    Raises:
        InputError: the file is missing or damaged, or a tensor is missing or has another shape.
    """
    state, values = _state(model)
    prefix = getattr(model, "PREFIX", "")
    loaded = {}
    try:
        open_file(path).close()
        with safetensors.safe_open(path, "numpy") as file:
            names = set(file.keys())
            for keys, value in values.items():
                name, wanted = _tensor_name(keys, prefix), _torch_shape(value.shape, keys[-1])
                if name not in names:
                    raise InputError(
                        f"weights: {path} has no tensor {name}; expected one of shape {wanted}: give the "
                        "file of the network's backbone"
                    )
                array = file.get_tensor(name).astype(np.float32)
                if keys[-1] == "pos_embed":
                    array = resampled_positions(array, wanted)
                if array.shape != wanted:
                    raise InputError(
                        f"weights: {name} in {path} has the shape {array.shape}; expected {wanted}: give the "
                        "file of the network's backbone"
                    )
                axes = (*range(2, array.ndim), 1, 0) if keys[-1] == "kernel" else range(array.ndim)
                loaded[keys] = jnp.asarray(array.transpose(*axes))
    except (OSError, safetensors.SafetensorError, TypeError) as error:
        raise InputError(
            f"weights: {path} cannot be read ({error}); expected a safetensors file, see docs/baselines.md"
        ) from None
    nnx.replace_by_pure_dict(state, flax.traverse_util.unflatten_dict(loaded))
    nnx.update(model, state)


def resampled_positions(positions: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return the positions [1, 1 + G*G, D] of a ViT on another square grid, bicubic, as timm resamples them.

    Positions of another length D, or of a grid that is not square, are returned as they are.
    """
    import jax

    sides = [round((n - 1) ** 0.5) for n in (positions.shape[1], shape[1])] if positions.ndim == 3 else [0, 0]
    square = positions.ndim == 3 and sides[0] ** 2 + 1 == positions.shape[1]
    if positions.shape == shape or not square or positions.shape[2] != shape[2]:
        return positions
    grid = positions[0, 1:].reshape(sides[0], sides[0], -1)
    resized = jax.image.resize(grid, (sides[1], sides[1], grid.shape[2]), "cubic")
    return np.concatenate([positions[0, :1], np.asarray(resized).reshape(sides[1] ** 2, -1)])[None]
