"""Records of recognition: the described instances of a frame, and the answers."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, cast, get_args

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["MAX_OVERFLOW", "AnswerBy", "DescribedFrame", "Recognition", "check_answer_by"]

AnswerBy = Literal["classifiers", "gallery", "both"]
"""Sources of answers."""

MAX_OVERFLOW = 0.5
"""Largest overflow of an answer with a name, as a fraction of the points: beyond it, too little is described."""


@dataclasses.dataclass(frozen=True)
class Recognition:
    """The answer for one instance of a frame.

    Attributes:
        label: its number in the label image.
        name: the object's name. None if the instance could not be described (fewer points than
            `instance_clouds.MIN_POINTS`), if more than half of its points overflow (`MAX_OVERFLOW`), or if its
            confidence is below `unknown_below` (see `inference.answers`): an unknown object.
        confidence: from 0 to 1, also of an unknown object: estimated probability that the name of a known object is
            correct; low for most unknown objects (see `model.confidence`). Without a calibration, the fused
            probability of the most probable class or the score of the gallery. None if the instance could not be
            described.
        classifier: the classifier that gives this class the largest probability ("tops", "tops2" or "embedding"), or
            "gallery".
        top: classifier or "gallery" -> its five most probable (name, probability) pairs.
        occluded: another instance hides a part of it, or the image border cuts it.
        overflow: points and persistence pairs outside the descriptor's grid, see `Descriptors`.
        points_used: points of the described cloud.
        kept_by_fallback: a rule of outlier removal would have dropped most of the cloud and was skipped.
        reason: why `name` is None; None if it is not.
    """

    label: int
    name: str | None = None
    confidence: float | None = None
    classifier: str | None = None
    top: dict[str, list[tuple[str, float]]] = dataclasses.field(default_factory=dict)
    occluded: bool = False
    overflow: int = 0
    points_used: int = 0
    kept_by_fallback: bool = False
    reason: str | None = None


@dataclasses.dataclass(frozen=True)
class DescribedFrame:
    """The instances of a frame and the descriptors of those that can be used.

    Attributes:
        instances: every instance, in the order of the label numbers.
        oriented: descriptors of all looks, as NumPy arrays with one row for each of `usable`, padded to a batch
            bucket.
    """

    instances: Sequence[PreparedInstance]
    oriented: LookDescriptors

    @property
    def descriptors(self) -> Descriptors:
        """The descriptors of the first look, the paper's."""
        return self.oriented.first

    @property
    def usable(self) -> list[PreparedInstance]:
        """The instances that were described, in the order of the rows."""
        return [instance for instance in self.instances if instance.reason is None]

    @property
    def packed(self) -> PointClouds:
        """The described clouds in metres, padded as `descriptors` are."""
        return pack_instances(self.usable, len(self.oriented.weights))


def check_answer_by(value: str | None) -> AnswerBy | None:
    """Return the source of the answers, or None if it is not given.

    Raises:
        InputError: it is unknown.
    """
    if value not in (None, *get_args(AnswerBy)):
        raise InputError(f"answer_by is {value!r}; expected one of {', '.join(get_args(AnswerBy))}")
    return cast(AnswerBy | None, value)
