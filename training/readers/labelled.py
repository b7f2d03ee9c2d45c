"""A frame with the truth about it."""

import dataclasses
from collections.abc import Mapping

from thor2_jax.frames import RGBDFrame

__all__ = ["LabelledFrame"]


@dataclasses.dataclass(frozen=True, eq=False)
class LabelledFrame:
    """What every reader yields.

    Attributes:
        identifier: names the frame within its dataset.
        frame: the images.
        truth: label number -> object name, of the instances that are scored. An instance may have no pixel in the label
            image.
        attributes: what accuracy is broken down by, for instance {"occlusion": "high", "light": "1"}.
    """

    identifier: str
    frame: RGBDFrame
    truth: Mapping[int, str]
    attributes: Mapping[str, str]
