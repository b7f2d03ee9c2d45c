"""The files of pretrained weights that baselines read."""

from pathlib import Path

from thor2_jax.errors import InputError
from training.baselines.names import TEMPLATES
from training.baselines.networks.architectures import ARCHITECTURES
from training.baselines.templates import DINOV2

__all__ = ["pretrained_files", "weights_file"]


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
