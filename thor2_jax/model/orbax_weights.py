"""Weights in run directories of format 1, which were Orbax checkpoints. Nothing writes them any more."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import directory_digest
from thor2_jax.model.classifier import MLP
from thor2_jax.model.weights import model_from_arrays

__all__ = ["load_orbax_classifier"]


def load_orbax_classifier(path: Path, create: Callable[[], MLP], digest: str) -> MLP:
    """Read a classifier from the Orbax checkpoint in `path`.

    Its digest is compared first: Orbax does not notice all damage, and where it does, its threads print tracebacks.

    Raises:
        InputError: the checkpoint is missing, damaged or of another shape.
    """
    import orbax.checkpoint as ocp  # type: ignore[import-untyped]

    if not path.is_dir():
        raise InputError(f"model: {path} is missing; copy the whole run directory")
    shapes = nnx.to_pure_dict(nnx.state(nnx.eval_shape(create), (nnx.Param, nnx.BatchStat)))
    n_inputs, n_classes = len(shapes["input_scale"]), len(shapes["head"]["bias"])
    if digest != directory_digest(path, f"{n_inputs} {n_classes}"):
        raise InputError(f"model: {path} is damaged, or not of {n_inputs} inputs and {n_classes} classes")
    process = jax.process_index()
    alone = ocp.options.MultiprocessingOptions(primary_host=process, active_processes={process})
    try:
        with ocp.StandardCheckpointer(multiprocessing_options=alone) as checkpointer:
            target = jax.tree.map(lambda a: np.zeros(a.shape, a.dtype), shapes)
            restored = checkpointer.restore(path, target)
    except Exception as error:  # Orbax passes on all exceptions of its storage layers
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:300]
        raise InputError(f"model: {path} cannot be read ({reason})") from None
    return model_from_arrays(create, {"/".join(map(str, keys)): a for keys, a in _leaves(restored)})


def _leaves(tree: dict[object, object], path: tuple[object, ...] = ()) -> list[tuple[tuple[object, ...], NDArray[Any]]]:
    leaves = []
    for key, value in tree.items():
        leaves += _leaves(value, (*path, key)) if isinstance(value, dict) else [((*path, key), np.asarray(value))]
    return leaves
