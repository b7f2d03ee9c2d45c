"""What a baseline is, what it is trained on, and what it is asked about."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.view_normalization import view_normalize
from thor2_jax.recognition.recognizer import DescribedFrame
from thor2_jax.types import PointClouds
from training.fitting.folds import fold_of_views
from training.fitting.options import FitOptions
from training.views.normalized_views import ViewSource

__all__ = ["TITLES", "Baseline", "Fitted", "Seen", "Task", "seen_in"]

TITLES = {"forest": "forest", "pointnet": "PointNet", "thor": "THOR"}
"""What the baselines are called in tables, in their order there."""


class Seen(NamedTuple):
    """The B instances of a described frame, as baselines read them.

    Attributes:
        normal: view-normalized clouds, scaled units.
        tops: [B, F] float32, their TOPS.
    """

    normal: PointClouds
    tops: NDArray[np.float32]


def seen_in(described: DescribedFrame, config: DescriptorConfig) -> Seen:
    """The instances of a frame, row by row as in `described.packed`."""
    return Seen(view_normalize(described.packed, config), np.asarray(described.descriptors.tops))


class Baseline(Protocol):
    """A trained baseline."""

    def probabilities(self, seen: Seen) -> NDArray[np.float32]:
        """[B, C] class probabilities."""

    def arrays(self) -> Mapping[str, NDArray[Any]]:
        """All that it has learned."""


@dataclasses.dataclass(frozen=True)
class Task:
    """What a baseline is trained on.

    Attributes:
        source: the run's views.
        network: the run's colour network.
        config: the run's descriptor.
        options: those of the run's classifiers.
        folds: into how many parts the views are dealt.
        fold: the one that is held out, if there are several.
        scratch: folder for what a training that is stopped goes on from.
        progress: told (stage, done, total, note).
    """

    source: ViewSource
    network: ColorNetwork
    config: DescriptorConfig
    options: FitOptions
    folds: int
    fold: int
    scratch: Path
    progress: Callable[[str, int, int, str], object]

    def held_out(self, label: NDArray[np.integer[Any]], view: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """Which clouds [M] are held out, by class and number of their view: those that the run held out too."""
        if self.folds == 1:
            return np.zeros(len(label), bool)
        return fold_of_views(label, view, self.source.classes, self.folds, self.options.seed) == self.fold


class Fitted(NamedTuple):
    """A baseline and what it says of the H clouds held out.

    Attributes:
        model: the baseline.
        probabilities: [H, C].
        truth: [H] class indices.
    """

    model: Baseline
    probabilities: NDArray[np.float32]
    truth: NDArray[np.integer[Any]]
