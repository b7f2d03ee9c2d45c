"""Which augmentations are on, and a view with all of them."""

import dataclasses
from typing import Any

import numpy as np

from thor2_jax.errors import InputError
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.outlier_removal import flying_pixels
from training.augmentation.illumination import Illumination, relit
from training.augmentation.occlusion import Occlusion, occluded
from training.augmentation.pixels import without
from training.augmentation.segmentation import Segmentation, resegmented
from training.augmentation.sensor import Sensor, sensed
from training.rendering.camera import RenderedView

__all__ = ["Augmentations", "augment"]


@dataclasses.dataclass(frozen=True)
class Augmentations:
    """Variations of training views; None is off. False if all are off.

    Attributes:
        illumination: light and camera response.
        sensor: noise and faults of depth.
        occlusion: another object in front.
        segmentation: masks too small or too large.
        copies: varied copies of each view.

    Raises:
        InputError: `copies` is no whole number of at least 1, or a variation is of another type.
    """

    illumination: Illumination | None = None
    sensor: Sensor | None = None
    occlusion: Occlusion | None = None
    segmentation: Segmentation | None = None
    copies: int = 2

    def __post_init__(self) -> None:
        kinds = {
            "illumination": Illumination,
            "sensor": Sensor,
            "occlusion": Occlusion,
            "segmentation": Segmentation,
        }
        for name, kind in kinds.items():
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InputError(f"augmentations.{name} is {value!r}; it must be None or {kind.__name__}")
        if not isinstance(self.copies, int) or isinstance(self.copies, bool) or self.copies < 1:
            raise InputError(f"augmentations.copies is {self.copies!r}; it must be a whole number of at least 1")

    def __bool__(self) -> bool:
        return any((self.illumination, self.sensor, self.occlusion, self.segmentation))

    def record(self) -> dict[str, Any]:
        """All settings as JSON holds them: field -> value, None for a variation that is off, ranges as lists."""

        def plain(items: list[tuple[str, Any]]) -> dict[str, Any]:
            return {name: list(value) if isinstance(value, tuple) else value for name, value in items}

        return dataclasses.asdict(self, dict_factory=plain)


def augment(view: RenderedView, augmentations: Augmentations, rng: np.random.Generator) -> RenderedView:
    """A varied copy of a view: the same for the same arguments and state of `rng`.

    In the order of what happens to a frame: light, the mask's error, another object in front, the depth camera. As
    recognition does, pixels that fly are dropped where mask or camera can have made some.

    Args:
        view: unchanged.
        augmentations: what to vary.
        rng: of everything random.

    Returns:
        A view with the same pose. A mask that reaches past the outline needs room: there the part of the image, its
        corner and its intrinsics may be larger by some pixels.
    """
    if augmentations.illumination:
        view = relit(view, augmentations.illumination, rng)
    if augmentations.segmentation:
        view = resegmented(view, augmentations.segmentation, rng)
    if augmentations.occlusion:
        view = occluded(view, augmentations.occlusion, rng)
    if augmentations.sensor:
        view = sensed(view, augmentations.sensor, rng)
    return _without_flying(view) if augmentations.segmentation or augmentations.sensor else view


def _without_flying(view: RenderedView) -> RenderedView:
    """As in `instance_clouds`: not if it were more than half of the pixels."""
    frame = RGBDFrame(view.color, view.depth, (view.depth > 0).astype(np.uint8), view.intrinsics)
    pixels = np.flatnonzero(view.depth)
    flying = flying_pixels(frame, pixels)
    return view if 2 * flying.sum() > len(pixels) else without(view, pixels[flying])
