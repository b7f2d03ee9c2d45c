"""The classes of the classifiers and the objects of the gallery as one list, and the probabilities of both combined."""

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.printable import first_names

__all__ = ["TOYS", "ClassUnion", "score_odds"]

TOYS = frozenset(
    ("apple banana cereal_box_blue cereal_box_yellow hammer mug_blue mug_white screwdriver soup_can_green soup_can_red "
     "sponge tennis_ball white_bowl white_cup white_plate wooden_spoon yellow_bottle yellow_box").split()
)  # fmt: skip
"""The built-in objects, the classes of the demo's model."""

MAX_LISTED = 6
"""Names that `ClassUnion.summary` lists."""

EVEN, STEEPNESS = 0.2, 3
"""A score s has the odds (s / EVEN) ** STEEPNESS against everything that is not enrolled; chosen on held-out frames."""

Values = NDArray[np.floating[Any]]


def score_odds(scores: NDArray[Any]) -> NDArray[Any]:
    """Return the odds of scores against everything that is not enrolled."""
    return np.asarray((scores / EVEN) ** STEEPNESS)


@dataclasses.dataclass(frozen=True)
class ClassUnion:
    """The names that a recognizer may answer: trained classes that are not hidden, then further objects of the gallery.

    Attributes:
        trained: class names, in the order of the classifiers' outputs.
        enrolled: names of the gallery's objects, in the order of its scores.
        hidden: trained classes that no classifier answers by.
    """

    trained: tuple[str, ...]
    enrolled: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()

    @functools.cached_property
    def _outputs(self) -> tuple[str | None, ...]:
        """The name of each output of the classifiers; None for hidden classes."""
        hidden = set(self.hidden)
        return tuple(None if name in hidden else name for name in self.trained)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """All names."""
        return tuple(dict.fromkeys(name for name in (*self._outputs, *self.enrolled) if name is not None))

    @functools.cached_property
    def has_output(self) -> NDArray[np.bool_]:
        """[n] bool, whether the classifiers have an output for each name."""
        outputs = set(self._outputs)
        return np.array([name in outputs for name in self.names], bool)

    @functools.cached_property
    def summary(self) -> str:
        """The names in words, such as "21 objects: mug, bowl, ..."."""
        toys = [name for name in self.names if name in TOYS] if set(self.trained) == TOYS else []
        own = [name for name in self.names if name not in toys]
        listed = first_names(own, MAX_LISTED)
        if toys:
            others = f", and {listed}" if own else "; it knows nothing of yours"
            return f"{len(toys)} toy objects of the demo{others}"
        return f"{len(own)} {'objects' if len(own) != 1 else 'object'}: {listed}" if own else "no object yet"

    def of_classifiers(self, probabilities: Values) -> Values:
        """Return class probabilities [B, C] in the order of `names` [B, n]; 0 for names without an output."""
        return self._spread(probabilities, self._outputs)

    def of_gallery(self, scores: Values) -> Values:
        """Return scores of the gallery [B, n_objects] in the order of `names` [B, n]; 0 for names without views."""
        return self._spread(scores, self.enrolled)

    def _spread(self, values: Values, owners: tuple[str | None, ...]) -> Values:
        if owners == self.names:
            return values
        result = np.zeros((len(values), len(self.names)), values.dtype)
        column = {name: index for index, name in enumerate(owners)}
        known = [index for index, name in enumerate(self.names) if name in column]
        result[:, known] = values[:, [column[self.names[index]] for index in known]]
        return result

    def combine(self, probabilities: Values | None, scores: Values) -> Values:
        """Combine the confidences of the classifiers with the scores of the gallery.

        The shares of the names are the confidence of a trained class, and for an enrolled object what the best class
        leaves to 1, times the odds of the object's score. The largest share is the answer. A class that is the answer
        keeps its confidence c. If an object is, or has a share in it, the answer has the probability that it is known
        at all, (c + m) / (1 + m), where c and m are the largest shares of a class and of an object. The values of the
        others are in proportion. So an enrolled object takes the name only where its score is high.

        Args:
            probabilities: [B, C], fused; None if the gallery alone answers.
            scores: [B, n_objects].

        Returns:
            [B, n] from 0 to 1, in the order of `names`; they need not sum to 1.
        """
        nothing: Values = np.zeros((len(scores), len(self.names)))
        trained = nothing if probabilities is None else self.of_classifiers(probabilities)
        c = trained.max(axis=1, keepdims=True, initial=0)
        # Without a score, an object still comes before a class that neither has views nor an output.
        odds = np.maximum(score_odds(scores), np.finfo(np.float32).tiny)
        enrolled = (1 - c).clip(0) * self.of_gallery(odds)
        shares, m = trained + enrolled, enrolled.max(axis=1, keepdims=True, initial=0)
        largest = shares.max(axis=1, keepdims=True, initial=0)
        value = np.where(largest > c, (c + m) / (1 + m), c)
        return shares / np.maximum(largest, np.finfo(np.float32).tiny) * value
