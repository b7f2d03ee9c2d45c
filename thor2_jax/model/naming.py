"""Naming: the answer for each instance of a frame, from the values of all names."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.answers import MAX_OVERFLOW, Recognition

__all__ = ["name_instances"]

N_TOP = 5
"""Most probable names of each classifier that an answer lists."""


def name_instances(
    instances: Sequence[PreparedInstance],
    names: Sequence[str],
    values: NDArray[np.floating[Any]],
    thresholds: NDArray[np.float64],
    by_source: Mapping[str, NDArray[Any]],
    overflow: NDArray[Any],
) -> list[Recognition]:
    """Return the answer for each instance.

    Args:
        instances: all of a frame; the B usable ones are the rows of the arrays, in order.
        names: the n names that may be answered.
        values: [B, n] probabilities; the largest one of a row is the answer's confidence.
        thresholds: [n] least confidence of an answer with each name.
        by_source: classifier or "gallery" -> its own probabilities [B, n].
        overflow: [B] int, see `Descriptors`.
    """
    rows = iter(range(len(values)))
    answers = []
    for instance in instances:
        if instance.reason is not None:
            answers.append(Recognition(instance.label, reason=instance.reason))
            continue
        row = next(rows)
        of_source = {source: array[row] for source, array in by_source.items()}
        answers.append(_answer(instance, names, values[row], thresholds, of_source, int(overflow[row])))
    return answers


def _answer(
    instance: PreparedInstance,
    names: Sequence[str],
    values: NDArray[np.floating[Any]],
    thresholds: NDArray[np.float64],
    by_source: Mapping[str, NDArray[Any]],
    overflow: int,
) -> Recognition:
    best = int(values.argmax()) if names else -1
    confidence = float(values[best]) if names else 0.0
    reason = None
    if overflow > MAX_OVERFLOW * len(instance.points):
        reason = (
            f"overflow: {overflow} points and pairs of {len(instance.points)} points lie outside the descriptor's "
            "grid; check the intrinsics and the depth scale"
        )
    elif not names:
        reason = "unknown: no object is enrolled"
    elif confidence < thresholds[best]:
        reason = f"unknown: a confidence of {confidence:.3f}, below {thresholds[best]:.3g}"
    return Recognition(
        label=instance.label,
        name=names[best] if reason is None else None,
        confidence=confidence,
        classifier=max(by_source, key=lambda source: by_source[source][best]) if names else None,
        top={source: _top(names, of_source) for source, of_source in by_source.items()},
        occluded=instance.occluded,
        overflow=overflow,
        points_used=len(instance.points),
        kept_by_fallback=instance.kept_by_fallback,
        reason=reason,
    )


def _top(names: Sequence[str], values: NDArray[Any]) -> list[tuple[str, float]]:
    best = np.argsort(-values, kind="stable")[:N_TOP]
    return [(names[i], float(values[i])) for i in best]
