"""Weights of Flax modules as named arrays, which safetensors files hold."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import flax.traverse_util
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

__all__ = ["model_arrays", "model_from_arrays"]

Model = TypeVar("Model", bound=nnx.Module)


def _state(model: nnx.Module) -> tuple[Any, dict[tuple[Any, ...], Any]]:
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return state, dict(flax.traverse_util.flatten_dict(nnx.to_pure_dict(state)))


def _name(path: tuple[Any, ...]) -> str:
    return "/".join(map(str, path))


def model_arrays(model: nnx.Module) -> dict[str, NDArray[Any]]:
    """Return the parameters and batch statistics of a model by their paths, for example layers/0/kernel."""
    return {_name(path): np.asarray(array) for path, array in _state(model)[1].items()}


def model_from_arrays(create: Callable[[], Model], arrays: Mapping[str, NDArray[Any]]) -> Model:
    """Create a model with the given parameters and batch statistics; no weights are drawn.

    Args:
        create: function without arguments that constructs the model, its random generators included.
        arrays: arrays by name, as `model_arrays` returns them.

    Raises:
        ValueError: if an array is missing or has another shape.
    """
    model = nnx.eval_shape(create)
    state, expected = _state(model)
    loaded = {}
    for path, like in expected.items():
        name = _name(path)
        if name not in arrays or arrays[name].shape != like.shape:
            raise ValueError(f"{name} is missing or does not have the shape {like.shape}")
        loaded[path] = jnp.asarray(arrays[name])
    nnx.replace_by_pure_dict(state, flax.traverse_util.unflatten_dict(loaded))
    nnx.update(model, state)
    return model
