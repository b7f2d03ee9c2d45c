"""The classifiers of a run by name: compiled, evaluated, and chosen by default."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Self

import jax
from flax import nnx

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.model.classifier import EMBEDDING, MLP, Feature, oriented_probabilities

__all__ = ["THOR2", "Classifier", "RunClassifiers"]

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose fusion is THOR2."""

Classifier = Callable[[LookDescriptors], jax.Array]
"""From the descriptors of K looks at B clouds to class probabilities [B, C], which may sum to less than 1."""


class RunClassifiers(dict[str, Classifier]):
    """The classifiers of a run by name: the MLPs, and the embedding if it was fitted on the classes."""

    @classmethod
    def compiled(cls, models: Mapping[Feature, MLP], embedding: Classifier | None) -> Self:
        """Return compiled classifiers of MLPs, and the one of the embedding; None if it does not know the classes."""
        classifiers = cls((name, _compiled(name, model)) for name, model in models.items())
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

    def probabilities(self, oriented: LookDescriptors, names: Sequence[str]) -> dict[str, jax.Array]:
        """Return classifier -> class probabilities [B, C] on the device, of the classifiers with these names."""
        return {name: self[name](oriented) for name in names}


def _compiled(name: Feature, model: MLP) -> Classifier:
    """Return the compiled function from the descriptors of K looks to class probabilities [B, C]."""
    graph, state = nnx.split(model)
    # As a flat list: JAX would take an nnx state apart, in Python, at every call.
    leaves, structure = jax.tree.flatten(state)
    return partial(_forward(graph, structure, name), leaves)


@lru_cache(maxsize=16)
def _forward(graph: Any, structure: Any, name: Feature) -> Callable[[list[jax.Array], LookDescriptors], jax.Array]:
    """Return the function of a classifier's weights, which classifiers of its sizes share, with the programs."""

    @jax.jit
    def forward(leaves: list[jax.Array], oriented: LookDescriptors) -> jax.Array:
        return oriented_probabilities(nnx.merge(graph, jax.tree.unflatten(structure, leaves)), oriented, name)

    return forward
