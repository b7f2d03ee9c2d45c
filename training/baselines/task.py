"""Records that go into and come out of the fit of a baseline."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig
from training.baselines.baseline import Baseline
from training.fitting.folds import fold_of_views
from training.fitting.options import EpochMetrics, FitOptions
from training.views.normalized_views import ViewSource

__all__ = ["FitTask", "FittedBaseline"]


@dataclasses.dataclass(frozen=True)
class FitTask:
    """Data and options for fitting a baseline.

    Attributes:
        source: views of the run.
        network: colour network of the run.
        config: descriptor configuration of the run.
        options: options of the fit.
        folds: number of folds that the views are split into.
        fold: index of the held-out fold; nothing is held out if `folds` is 1.
        scratch: directory for checkpoints, so that an interrupted fit can resume.
        run: directory of the run.
        weights: directory of pretrained weights; None trains networks from scratch.
        progress: called with (stage, done, total, note).
    """

    source: ViewSource
    network: ColorNetwork
    config: DescriptorConfig
    options: FitOptions
    folds: int
    fold: int
    scratch: Path
    run: Path
    weights: Path | None
    progress: Callable[[str, int, int, str], object]

    def held_out(self, label: NDArray[np.integer[Any]], view: NDArray[np.integer[Any]]) -> NDArray[np.bool_]:
        """Return which clouds [M] are held out, given class index and view number: the same views as in the run."""
        if self.folds == 1:
            return np.zeros(len(label), bool)
        return fold_of_views(label, view, self.source.classes, self.folds, self.options.seed) == self.fold

    def report(self, name: str) -> Callable[[int, int, EpochMetrics], object]:
        """Return the function that shows the progress of `run_epochs` for a network of this name."""

        def report(done: int, total: int, metrics: EpochMetrics) -> None:
            self.progress(f"fit {name}", done, total, f"epoch {metrics.epoch}, accuracy {metrics.accuracy:.3f}")

        return report


class FittedBaseline(NamedTuple):
    """A baseline and its predictions for the H held-out clouds.

    Attributes:
        model: the baseline.
        probabilities: [H, C] class probabilities.
        truth: [H] class indices.
        weights: files of pretrained weights it was fitted from -> SHA-256.
    """

    model: Baseline
    probabilities: NDArray[np.float32]
    truth: NDArray[np.integer[Any]]
    weights: Mapping[str, str] = MappingProxyType({})
