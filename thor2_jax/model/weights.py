"""Weights of Flax modules as named arrays, which safetensors files hold."""

import functools
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


@functools.lru_cache(maxsize=64)
def _traced(create: Callable[..., nnx.Module], *arguments: Any) -> tuple[Any, Any]:
    graph, state = nnx.split(nnx.eval_shape(functools.partial(create, *arguments)))
    return graph, state


def _name(path: tuple[Any, ...]) -> str:
    return "/".join(map(str, path))


def model_arrays(model: nnx.Module) -> dict[str, NDArray[Any]]:
    """Return the parameters and batch statistics of a model by their paths, for example layers/0/kernel."""
    return {_name(path): np.asarray(array) for path, array in _state(model)[1].items()}


def model_from_arrays(create: Callable[[], Model], arrays: Mapping[str, NDArray[Any]]) -> Model:
    """Create a model with the given parameters and batch statistics; no weights are drawn.

    Args:
        create: function without arguments that constructs the model, its random generators included; one that is a
            `partial` without keywords is traced once for each function and arguments.
        arrays: arrays by name, as `model_arrays` returns them.

    Raises:
        ValueError: if an array is missing or has another shape.
    """
    if isinstance(create, functools.partial) and not create.keywords:
        model: Model = nnx.merge(*_traced(create.func, *create.args), copy=True)
    else:
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
