"""A trained baseline as one file, RUN/baselines/NAME.safetensors: arrays and a few words about them, no code.

What it says of itself: the format, the classes, the temperature (`calibration`; none if no views were held out), the
seconds that training took, and the digest of all that and the arrays.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import flax.traverse_util
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, content_digest, json_digest

__all__ = ["Stored", "arrays_of", "baseline_file", "model_with", "read_baseline", "write_baseline"]

FORMAT = 1


def baseline_file(run: Path, name: str) -> Path:
    """Where a run folder has its baseline of that name, or of that pattern of names."""
    return run / "baselines" / f"{name}.safetensors"


@dataclasses.dataclass(frozen=True, eq=False)
class Stored:
    """What a file holds.

    Attributes:
        arrays: by name.
        temperature: fitted on views held out; None if there were none.
        seconds: of training.
    """

    arrays: Mapping[str, NDArray[Any]]
    temperature: float | None
    seconds: float


def _digest(arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> str:
    parts: list[str | bytes] = [json_digest(about)]
    for name in sorted(arrays):
        parts += [f"{name} {arrays[name].dtype} {arrays[name].shape}\0", np.ascontiguousarray(arrays[name]).tobytes()]
    return content_digest(parts)


def write_baseline(path: Path, stored: Stored, classes: Sequence[str]) -> None:
    """Write a file; it appears whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    about = {
        "format": FORMAT,
        "classes": list(classes),
        "temperature": stored.temperature,
        "seconds": round(stored.seconds, 1),
    }
    about["digest"] = _digest(stored.arrays, about)
    arrays = {name: np.ascontiguousarray(array) for name, array in stored.arrays.items()}
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as temporary:
        safetensors.numpy.save_file(arrays, temporary, {"about": json.dumps(about)})


def read_baseline(path: Path, classes: Sequence[str]) -> Stored:
    """Read a file.

    Args:
        path: of the file.
        classes: those of its run.

    Raises:
        InputError: it is damaged, of another format, or of other classes; names the file.
    """
    try:
        with safetensors.safe_open(path, "numpy") as file:
            about = json.loads(file.metadata()["about"])
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        if about["format"] != FORMAT:
            raise InputError(f"model: {path} has format {about['format']!r}; this version reads {FORMAT}")
        if about["digest"] != _digest(arrays, about):
            raise ValueError("its digest is not that of what it holds")
        if about["classes"] != list(classes):
            raise InputError(f"model: {path} is not of its run's classes")
        return Stored(arrays, about["temperature"], about["seconds"])
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, safetensors.SafetensorError) as error:
        raise InputError(f"model: {path} cannot be read: {error}; without it, it is trained again") from None


def _flat(state: Any) -> dict[str, Any]:
    return dict(flax.traverse_util.flatten_dict(nnx.to_pure_dict(state)))


def arrays_of(model: nnx.Module) -> dict[str, NDArray[Any]]:
    """Parameters and batch statistics of a model, by their paths."""
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return {"/".join(map(str, path)): np.asarray(array) for path, array in _flat(state).items()}


def model_with(model: nnx.Module, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """`model` with these parameters and batch statistics in place of its own.

    Raises:
        ValueError: one is missing or has another shape.
    """
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    found = {}
    for path, own in _flat(state).items():
        name = "/".join(map(str, path))
        if name not in arrays or arrays[name].shape != own.shape:
            raise ValueError(f"{name} is missing or has not the shape {own.shape}")
        found[path] = jnp.asarray(arrays[name])
    nnx.replace_by_pure_dict(state, flax.traverse_util.unflatten_dict(found))
    nnx.update(model, state)
    return model
