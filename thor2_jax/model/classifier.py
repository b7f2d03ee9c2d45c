"""The classifiers (paper, section "Recognition"): one MLP for each kind of descriptor.

Those of a run are compiled functions by name, from descriptors to class probabilities.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, Self

import jax
from flax import nnx

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.networks import MLP, compiled
from thor2_jax.types import Descriptors

__all__ = [
    "EMBEDDING",
    "FEATURES",
    "THOR2",
    "Classifier",
    "Feature",
    "RunClassifiers",
    "check_features",
    "feature_of",
]

Feature = Literal["ce", "tops", "tops2"]
FEATURES: tuple[Feature, ...] = ("ce", "tops", "tops2")
"""Descriptors that a classifier can be trained on: colour embeddings, TOPS, TOPS2."""

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose fusion is THOR2."""

EMBEDDING = "embedding"
"""Name of the class probabilities that the embedding of a run gives, beside those of the MLPs."""

Classifier = Callable[[LookDescriptors], jax.Array]
"""From the descriptors of K looks at B clouds to class probabilities [B, C], which may sum to less than 1."""


def check_features(names: object, argument: str) -> tuple[Feature, ...]:
    """Return `names` as a tuple of known features in the order of FEATURES.

    Raises:
        InputError: a name is unknown or given twice, or there is none; the message names `argument`.
    """
    values = tuple(names) if isinstance(names, (list, tuple)) else ()
    if not values or len(set(values)) != len(values) or not set(values) <= set(FEATURES):
        raise InputError(f"{argument} is {names!r}; expected one or more of {', '.join(FEATURES)}")
    return tuple(name for name in FEATURES if name in values)


def feature_of(descriptors: Descriptors, name: Feature) -> jax.Array:
    """Return the flat descriptor [B, F] that the classifier of this name reads."""
    return {"ce": descriptors.color, "tops": descriptors.tops, "tops2": descriptors.tops2}[name]


def _fused_probabilities(models: Sequence[MLP], oriented: LookDescriptors, name: Feature) -> jax.Array:
    (model,) = models
    return oriented.fuse(model(feature_of(oriented.flat[0], name)))


class RunClassifiers(dict[str, Classifier]):
    """The classifiers of a run by name: the MLPs, and the embedding if it was fitted on the classes."""

    @classmethod
    def compiled(cls, models: Mapping[Feature, MLP], embedding: Classifier | None) -> Self:
        """Return compiled classifiers of MLPs, and the one of the embedding; None if it does not know the classes."""
        classifiers = cls(
            (name, compiled(_fused_probabilities, [nnx.split(each)], name)) for name, each in models.items()
        )
        if embedding is not None:
            classifiers[EMBEDDING] = embedding
        return classifiers

    @property
    def default(self) -> tuple[str, ...]:
        """Names of the paper's two and of the embedding, as far as the run has them; of all if it has none of these."""
        return tuple(name for name in (*THOR2, EMBEDDING) if name in self) or tuple(self)

    def checked(self, names: Sequence[str] | None) -> tuple[str, ...]:
        """Return names without repetitions; None stands for `default`.

        Raises:
            InputError: there is no name, or a classifier that the run does not have.
        """
        names = self.default if names is None else names
        if not isinstance(names, (list, tuple)) or not names or not set(names) <= set(self):
            raise InputError(f"classifiers is {names!r}; expected one or more of {', '.join(self)}")
        return tuple(dict.fromkeys(names))
