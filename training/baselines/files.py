"""Names and files of trained baselines, RUN/baselines/NAME.safetensors.

The metadata entry "about" is JSON: the format, the classes, the temperature (null without a held-out set), the training
time in seconds, the files of pretrained weights if there were any, and a digest of these entries and the arrays.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, content_digest, json_digest, pack_arrays, read_file, unpack_arrays

__all__ = [
    "BASELINES",
    "CLOUD_BASELINES",
    "NETWORKS",
    "StoredBaseline",
    "TEMPLATES",
    "TITLES",
    "baseline_file",
    "check_baselines",
    "read_baseline",
    "write_baseline",
]

CLOUD_BASELINES = ("thor", "forest", "pointnet")
"""Baselines on point clouds."""

NETWORKS = ("rcfusion", "rcfusion-small", "vit-cnn", "vit-cnn-small", "rgbd-vit", "rgbd-vit-small")
"""Image networks on crops of colour and surface normals."""

TEMPLATES = "templates"
"""The nearest template by the features of a frozen backbone, which may be that of a network of the same run."""

BASELINES = (*CLOUD_BASELINES, *NETWORKS, TEMPLATES)
"""Names on the command line and in run directories, in the order of training."""

TITLES = {
    "forest": "forest",
    "pointnet": "PointNet",
    "thor": "THOR",
    "rcfusion": "RCFusion",
    "rcfusion-small": "RCFusion-small",
    "vit-cnn": "ViT-CNN",
    "vit-cnn-small": "ViT-CNN-small",
    "rgbd-vit": "RGB-D ViT",
    "rgbd-vit-small": "RGB-D ViT-small",
    "templates": "templates",
}
"""Column titles of the baselines, in the order of the columns."""


def check_baselines(names: Sequence[str]) -> tuple[str, ...]:
    """Return `names` in the order of BASELINES.

    Raises:
        InputError: a name is unknown or given twice.
    """
    if not set(names) <= set(BASELINES) or len(set(names)) != len(names):
        raise InputError(
            f"baselines is {', '.join(names)}; expected any of {', '.join(BASELINES)}; give each at most once"
        )
    return tuple(name for name in BASELINES if name in names)


BASELINE_FORMAT = 1


def baseline_file(run: Path, name: str) -> Path:
    """Return the path of a baseline in a run directory; `name` may be a glob pattern."""
    return run / "baselines" / f"{name}.safetensors"


@dataclasses.dataclass(frozen=True, eq=False)
class StoredBaseline:
    """Contents of a baseline file.

    Attributes:
        arrays: learned arrays by name.
        temperature: temperature fitted on the held-out set; None without one.
        weights: files of pretrained weights it was fitted from -> SHA-256; empty if it was trained from scratch.
    """

    arrays: Mapping[str, NDArray[Any]]
    temperature: float | None
    weights: Mapping[str, str] = dataclasses.field(default_factory=dict)


def _digest(arrays: Mapping[str, NDArray[Any]], about: Mapping[str, Any]) -> str:
    parts: list[str | bytes] = [json_digest(about)]
    for name in sorted(arrays):
        parts += [f"{name} {arrays[name].dtype} {arrays[name].shape}\0", np.ascontiguousarray(arrays[name]).tobytes()]
    return content_digest(parts)


def write_baseline(path: Path, stored: StoredBaseline, classes: Sequence[str], seconds: float) -> None:
    """Write a baseline file and its training time atomically, and create its directory if it is missing.

    Raises:
        OSError: if the file cannot be written.
    """
    about: dict[str, Any] = {
        "format": BASELINE_FORMAT,
        "classes": list(classes),
        "temperature": stored.temperature,
        "seconds": round(seconds, 1),
    }
    if stored.weights:
        about["weights"] = dict(stored.weights)
    about["digest"] = _digest(stored.arrays, about)
    path.parent.mkdir(exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(pack_arrays(stored.arrays, {"about": json.dumps(about)}))


def read_baseline(path: Path, classes: Sequence[str]) -> StoredBaseline:
    """Read a baseline file.

    Args:
        path: path of the file.
        classes: class names of its run.

    Raises:
        InputError: if the file is damaged or has another format or other classes; the message names the file.
    """
    try:
        arrays, metadata = unpack_arrays(read_file(path))
        about = json.loads(metadata["about"])
        if about["format"] != BASELINE_FORMAT:
            raise InputError(
                f"model: {path} has format {about['format']!r}; expected {BASELINE_FORMAT}; train the baseline again"
            )
        if about.pop("digest") != _digest(arrays, about):
            raise ValueError("its digest does not match")
        if about["classes"] != list(classes):
            raise InputError(f"model: {path} has other classes than its run; train the baseline again")
        return StoredBaseline(arrays, about["temperature"], about.get("weights", {}))
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"model: {path} cannot be read ({error}); remove it and train the baseline again") from None
