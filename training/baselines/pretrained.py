"""The files of pretrained weights that baselines read."""

from pathlib import Path
from typing import Any

from flax import nnx

from thor2_jax.errors import InputError
from training.baselines.names import TEMPLATES
from training.baselines.networks.architectures import ARCHITECTURES
from training.baselines.networks.weights import load_backbone
from training.baselines.templates import DINOV2, create_backbone

__all__ = ["check_weights", "pretrained_files", "weights_file"]


def pretrained_files(name: str) -> list[str]:
    """Return the files of pretrained weights that a baseline reads, without the suffix; none for most baselines."""
    if name == TEMPLATES:
        return [DINOV2]
    return sorted(set(ARCHITECTURES[name].weights.values())) if name in ARCHITECTURES else []


def weights_file(directory: Path, name: str) -> Path:
    """Return the file of a backbone's pretrained weights.

    Raises:
        InputError: it does not exist.
    """
    path = directory / f"{name}.safetensors"
    if not path.is_file():
        raise InputError(f"weights: {path} does not exist; expected it in the directory, see docs/baselines.md")
    return path


def check_weights(directory: Path, name: str) -> None:
    """Read the files of a baseline's pretrained weights, without keeping them.

    Raises:
        InputError: a file is missing, damaged or of another architecture.
    """
    paths = {file: weights_file(directory, file) for file in pretrained_files(name)}
    if name == TEMPLATES:
        load_backbone(nnx.eval_shape(lambda: create_backbone(DINOV2)), paths[DINOV2])
    elif paths:
        architecture = ARCHITECTURES[name]
        model: Any = nnx.eval_shape(lambda: architecture.build(2, 0))
        for backbone, file in architecture.weights.items():
            load_backbone(getattr(model, backbone), paths[file])
