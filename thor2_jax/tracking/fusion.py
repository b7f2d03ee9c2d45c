"""Fusion of the evidence for an object over several frames.

The log-probabilities of each classifier and the scores of the gallery are averaged, with the weights of the views.
Successive frames are nearly the same, so their probabilities are not multiplied as those of independent observations
would be: a track whose frames all have the same probabilities has the confidence of a single frame.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from thor2_jax.frames.prepared_instance import PreparedInstance

__all__ = ["FusedEvidence", "view_weight"]

OCCLUDED_WEIGHT = 0.5
"""Weight of a point of an occluded instance; other points weigh 1."""

HALF_LIFE = 30
"""Views of an object after which the weight of an older one has halved, so that a track can change its mind."""


def view_weight(instance: PreparedInstance) -> float:
    """Return the weight of a view: its number of points, which is its visible surface, less if it is occluded."""
    return len(instance.points) * (OCCLUDED_WEIGHT if instance.occluded else 1.0)


def _log_with_rest(probabilities: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the logarithms [C + 1] of probabilities [C] and of what they lack to 1."""
    rest = max(1 - float(probabilities.sum(dtype=np.float64)), 0.0)
    return np.log(np.maximum(np.append(probabilities.astype(np.float64), rest), np.finfo(np.float32).tiny))


class FusedEvidence:
    """The evidence of the views of one object.

    Attributes:
        weight: total weight of the views.
        logs: classifier -> weighted sum [C + 1] of log-probabilities, the last one that of no class.
        score_weight: total weight of the views with gallery scores.
        scores: weighted sum of the gallery's scores, by name of the object; None if the classifiers alone answer.
    """

    def __init__(self) -> None:
        self.weight = 0.0
        self.logs: dict[str, NDArray[np.float64]] = {}
        self.score_weight = 0.0
        self.scores: Mapping[str, float] | None = None

    def add(
        self, weight: float, probabilities: Mapping[str, NDArray[np.floating]], scores: Mapping[str, float] | None
    ) -> None:
        """Add a view.

        Args:
            weight: its weight, see `view_weight`.
            probabilities: classifier -> class probabilities [C], which may sum to less than 1.
            scores: object -> score of the gallery. Objects that were enrolled or forgotten since the last view start
                the sums again.
        """
        decay = 0.5 ** (1 / HALF_LIFE)
        self.weight = decay * self.weight + weight
        self.logs = {
            name: decay * self.logs.get(name, np.zeros(len(p) + 1)) + weight * _log_with_rest(p)
            for name, p in probabilities.items()
        }
        earlier = self.scores or {}
        if set(scores or {}) != set(earlier):
            self.score_weight, earlier = 0.0, dict.fromkeys(scores or {}, 0.0)
        self.score_weight = decay * self.score_weight + weight
        if scores is not None:
            scores = {name: decay * earlier[name] + weight * value for name, value in scores.items()}
        self.scores = scores

    def fused(self) -> tuple[dict[str, NDArray[np.float64]], dict[str, float] | None]:
        """Return classifier -> fused class probabilities [C], and object -> fused score; None without a gallery."""
        tiny = np.finfo(np.float64).tiny
        probabilities = {name: softmax(logs / max(self.weight, tiny))[:-1] for name, logs in self.logs.items()}
        if self.scores is None:
            return probabilities, None
        return probabilities, {name: value / max(self.score_weight, tiny) for name, value in self.scores.items()}
