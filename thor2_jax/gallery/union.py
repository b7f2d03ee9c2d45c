"""The classes of the classifiers and the objects of the gallery as one list, and the probabilities of both combined."""

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["ClassUnion"]

Values = NDArray[np.floating[Any]]


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
    def names(self) -> tuple[str, ...]:
        """All names."""
        hidden = set(self.hidden)
        shown = [name for name in self.trained if name not in hidden]
        return tuple(dict.fromkeys([*shown, *self.enrolled]))

    @functools.cached_property
    def has_output(self) -> NDArray[np.bool_]:
        """[n] bool, whether the classifiers have an output for each name."""
        shown = set(self.trained) - set(self.hidden)
        return np.array([name in shown for name in self.names], bool)

    @functools.cached_property
    def has_views(self) -> NDArray[np.bool_]:
        """[n] bool, whether the gallery has views for each name."""
        enrolled = set(self.enrolled)
        return np.array([name in enrolled for name in self.names], bool)

    def of_classifiers(self, probabilities: Values) -> Values:
        """Return class probabilities [B, C] in the order of `names` [B, n]; 0 for names without an output."""
        return self._spread(probabilities, self.trained, self.has_output)

    def of_gallery(self, scores: Values) -> Values:
        """Return scores of the gallery [B, n_objects] in the order of `names` [B, n]; 0 for names without views."""
        return self._spread(scores, self.enrolled, self.has_views)

    def _spread(self, values: Values, owners: tuple[str, ...], known: NDArray[np.bool_]) -> Values:
        if owners == self.names:
            return values
        result = np.zeros((len(values), len(self.names)), values.dtype)
        column = {name: index for index, name in enumerate(owners)}
        columns = [column[name] for name, has in zip(self.names, known, strict=True) if has]
        result[:, known] = values[:, columns]
        return result

    def combine(self, probabilities: Values, scores: Values) -> Values:
        """Combine the fused probabilities of the classifiers with the scores of the gallery.

        An object without an output takes its score. What the largest such score leaves is for the classes with an
        output: their probabilities are multiplied by one minus that score. A class with both takes the geometric mean.

        Args:
            probabilities: [B, C], fused.
            scores: [B, n_objects].

        Returns:
            [B, n] from 0 to 1, in the order of `names`; they need not sum to 1.
        """
        of_classifiers, of_gallery = self.of_classifiers(probabilities), self.of_gallery(scores)
        new = of_gallery[:, ~self.has_output]
        rest = 1 - new.max(axis=1, keepdims=True) if new.shape[1] else 1
        trained = of_classifiers * rest
        return np.where(
            self.has_output,
            np.where(self.has_views, np.sqrt(trained * of_gallery), trained),
            of_gallery,
        )
