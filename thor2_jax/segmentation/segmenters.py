"""Segmenters by name: the built-in one, and those of other packages.

    labels = segment(frame)                      # [H, W] integers, by the built-in segmenter "table"
    recognizer.recognize(segmented(frame, "sam"))

A segmenter is a function from a frame without labels to labels [H, W], which are integers; 0 is background. A package
offers a segmenter as an entry point in the group `ENTRY_POINTS`, see docs/segmentation.md.
"""

import dataclasses
import importlib
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError, needs_extra, reason_of, with_context
from thor2_jax.frames.frames import RGBDFrame, check_frame

__all__ = ["ENTRY_POINTS", "MODEL", "TABLE", "Segmenter", "load_segmenter", "segment", "segmented", "segmenter_names"]

Segmenter = Callable[[RGBDFrame], NDArray[Any]]
"""A function from a frame to labels [H, W]."""

ENTRY_POINTS = "thor2_jax.segmenters"
"""Entry point group of segmenters."""

TABLE = "table"
"""Name of the built-in segmenter, `table.segment_table`, which needs OpenCV (extra `segment`)."""

MODEL = "model"
"""Name of `Recognizer.segment` in commands that recognize; it refines `TABLE` by recognition."""


def segmenter_names() -> list[str]:
    """Return the names of all installed segmenters, the built-in one first."""
    return [TABLE, *sorted({point.name for point in entry_points(group=ENTRY_POINTS)} - {TABLE})]


def load_segmenter(name: str, others: Sequence[str] = ()) -> Segmenter:
    """Return the segmenter of this name.

    Args:
        name: name of the segmenter.
        others: further names that the caller takes, which the error message lists.

    Raises:
        InputError: no segmenter has this name, or its package cannot be imported.
    """
    if name == MODEL:
        raise InputError(
            f"segmenter is {name!r}, which only recognize and explain take; expected {', '.join(segmenter_names())}"
        )
    if name == TABLE:
        with needs_extra(f"segmenter is {name!r}, which", "OpenCV", "segment"):
            return importlib.import_module("thor2_jax.segmentation.table").segment_table
    points = list(entry_points(group=ENTRY_POINTS, name=name))
    if not points:
        names = ", ".join([*segmenter_names(), *others])
        raise InputError(
            f"segmenter is {name!r}; expected one of {names}, or install a package that offers it in the entry point "
            f"group {ENTRY_POINTS}"
        )
    subject = f"segmenter is {name!r}; {points[0].value}"
    # Importing a package of others may raise any exception.
    try:
        segmenter = points[0].load()
    except Exception as error:
        raise InputError(f"{subject} cannot be imported ({_reason(error)}); check its package") from None
    if not callable(segmenter):
        raise InputError(f"{subject} is of type {type(segmenter).__name__}; expected a function")
    return segmenter


def segment(frame: RGBDFrame, segmenter: str | Segmenter = TABLE) -> NDArray[Any]:
    """Return the labels [H, W] of `segmented`, integers; 0 is background. It has the same arguments and errors."""
    return segmented(frame, segmenter).label_image


def segmented(frame: RGBDFrame, segmenter: str | Segmenter = TABLE) -> RGBDFrame:
    """Return a frame with the labels of a segmenter; existing labels are ignored.

    Args:
        frame: colour, depth and intrinsics.
        segmenter: name of a segmenter, or a segmenter.

    Raises:
        InputError: the segmenter is unknown, raises an exception, or does not return labels of the frame's size.
    """
    check_frame(frame)
    function = load_segmenter(segmenter) if isinstance(segmenter, str) else segmenter
    name = segmenter if isinstance(segmenter, str) else getattr(segmenter, "__name__", type(segmenter).__name__)
    try:
        labels = function(dataclasses.replace(frame, labels=None))
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        raise InputError(f"segmenter {name} failed on the frame ({_reason(error)}); check its package") from error
    if not isinstance(labels, np.ndarray):
        raise InputError(
            f"segmenter {name} returned a value of type {type(labels).__name__}; expected integers of shape "
            f"{frame.depth.shape} (rows, columns), 0 for the background, as a NumPy array"
        )
    with with_context(f"segmenter {name} returned invalid labels"):
        return dataclasses.replace(frame, labels=labels)


def _reason(error: BaseException) -> str:
    """Return the type of an exception and its message, if it has one."""
    return ": ".join(dict.fromkeys((type(error).__name__, reason_of(error))))
