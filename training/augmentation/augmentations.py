"""Augmentations of training views. They go beyond the paper, and each can be switched off.

    augmentations = Augmentations(illumination=Illumination(), occlusion=Occlusion())
    copy = augment(caster.render(pose), augmentations, np.random.default_rng(0))

An augmented copy has the pose of its view. Illumination and registration change its colours only; segmentation adds or
removes pixels along the outline; the base removes the lowest pixels; occlusion removes pixels behind another object;
the sensor perturbs or removes depth. Where pixels are added or removed, colour and depth change together. The view as
rendered is always kept as copy 0.
"""

import dataclasses
import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.frames.outliers import flying_pixels
from training.augmentation.masks import Base, Occlusion, Segmentation, occluded, resegmented, without_base
from training.augmentation.sensing import Illumination, Registration, Sensor, misregistered, relit, sensed
from training.rendering.camera import RenderedView

__all__ = ["KINDS", "Augmentations", "augment"]

MAX_COPIES = 1000
"""Largest number of augmented copies of a view."""


KINDS: dict[str, tuple[type, Callable[[RenderedView, Any, np.random.Generator], RenderedView]]] = {
    "illumination": (Illumination, relit),
    "registration": (Registration, misregistered),
    "segmentation": (Segmentation, resegmented),
    "base": (Base, without_base),
    "occlusion": (Occlusion, occluded),
    "sensor": (Sensor, sensed),
}
"""The settings of each augmentation and the function that applies it, in the order in which they are applied."""


@dataclasses.dataclass(frozen=True)
class Augmentations:
    """Augmentations to apply; None disables one. The record is falsy if all are disabled.

    Attributes:
        illumination: light and camera response.
        sensor: noise and faults of the depth sensor.
        occlusion: another object in front.
        segmentation: masks that are too small or too large.
        registration: colour that is blurred and shifted against depth.
        base: masks without the lowest part of the object.
        copies: number of augmented copies of each view.

    Raises:
        InputError: `copies` is not from 1 to `MAX_COPIES`.
    """

    illumination: Illumination | None = None
    sensor: Sensor | None = None
    occlusion: Occlusion | None = None
    segmentation: Segmentation | None = None
    copies: int = 5
    registration: Registration | None = None
    base: Base | None = None

    @classmethod
    def of_names(cls, names: Iterable[str], copies: int = 5) -> "Augmentations":
        """Return the augmentations with these names, in their default settings."""
        return cls(**{name: KINDS[name][0]() for name in names}, copies=copies)

    def __post_init__(self) -> None:
        if not 1 <= self.copies <= MAX_COPIES:
            raise InputError(f"copies is {self.copies}; expected an integer from 1 to {MAX_COPIES}")

    def __bool__(self) -> bool:
        return any(getattr(self, name) for name in KINDS)

    def record(self) -> dict[str, Any]:
        """Return all settings in JSON types: None for a disabled augmentation, lists for ranges."""
        return dict(json.loads(json.dumps(dataclasses.asdict(self))))


def augment(view: RenderedView, augmentations: Augmentations, rng: np.random.Generator) -> RenderedView:
    """Return an augmented copy of a view, determined by the arguments and the state of `rng`.

    The order is illumination, registration, segmentation, base, occlusion, sensor. Flying pixels are removed after
    segmentation and sensor, as recognition does, that is, unless they are more than half of all pixels.

    Args:
        view: view as rendered; not modified.
        augmentations: the augmentations to apply, with their settings; an empty view is returned unchanged.
        rng: random number generator.

    Returns:
        A view with the same pose. If the mask is dilated, the image may be larger by some pixels on each side, with
        corner and intrinsics adapted.
    """
    if not view.depth.any():
        return view
    for name, (_, apply) in KINDS.items():
        settings = getattr(augmentations, name)
        view = apply(view, settings, rng) if settings else view
    if not (augmentations.segmentation or augmentations.sensor):
        return view
    pixels = np.flatnonzero(view.depth)
    flying = flying_pixels(view.frame, pixels)
    return view if 2 * flying.sum() > len(pixels) else view.without(pixels[flying])
