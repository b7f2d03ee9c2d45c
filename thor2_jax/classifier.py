"""The classifiers (paper, section "Recognition"): one MLP a descriptor, and the rule that joins their answers."""

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors

__all__ = [
    "FEATURES",
    "HIDDEN",
    "Feature",
    "Joined",
    "MLP",
    "check_features",
    "class_probabilities",
    "feature_of",
    "join",
]

Feature = Literal["ce", "tops", "tops2"]
FEATURES: tuple[Feature, ...] = ("ce", "tops", "tops2")
"""What a classifier can be trained on: colour embeddings, TOPS, TOPS2."""

HIDDEN = (512, 256, 128, 64)


def check_features(names: object, argument: str) -> tuple[Feature, ...]:
    """`names` as a tuple of known features, in the order of FEATURES, or an InputError that names `argument`."""
    values = tuple(names) if isinstance(names, (list, tuple)) else ()
    if not values or len(set(values)) != len(values) or not set(values) <= set(FEATURES):
        raise InputError(f"{argument} is {names!r}; expected one or more different ones of {', '.join(FEATURES)}")
    return tuple(name for name in FEATURES if name in values)


def feature_of(descriptors: Descriptors, name: Feature) -> jax.Array:
    """The flat descriptor [B, F] that a classifier of this name reads."""
    return {"ce": descriptors.color, "tops": descriptors.tops, "tops2": descriptors.tops2}[name]


class MLP(nnx.Module):
    """512-256-128-64 hidden units, each layer followed by batch normalization, ReLU and dropout of 0.2; then logits.

    Inputs are first scaled by fixed numbers of the training set (`input_scale`): images and colour counts differ a
    thousandfold in size, and the first step of Adam would see only the larger.
    """

    def __init__(self, n_inputs: int, n_classes: int, *, rngs: nnx.Rngs, dropout: float = 0.2) -> None:
        """Fresh weights for inputs [B, n_inputs] and logits [B, n_classes]."""
        sizes = (n_inputs, *HIDDEN)
        self.input_scale = nnx.BatchStat(jnp.ones(n_inputs))
        self.layers = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.norms = nnx.List([nnx.BatchNorm(n, momentum=0.9, rngs=rngs) for n in HIDDEN])
        self.dropout = nnx.Dropout(dropout)
        self.head = nnx.Linear(HIDDEN[-1], n_classes, rngs=rngs)

    def __call__(self, x: jax.Array, *, train: bool = False, rngs: nnx.Rngs | None = None) -> jax.Array:
        """Logits [B, n_classes] of descriptors [B, n_inputs].

        `train` uses the batch's own statistics, and dropout drawn from `rngs`.
        """
        x = x * self.input_scale[...]
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = nnx.relu(norm(layer(x), use_running_average=not train))
            x = self.dropout(x, deterministic=not train, rngs=rngs)
        return self.head(x)


def class_probabilities(model: MLP, descriptors: Descriptors, name: Feature) -> jax.Array:
    """Softmax [B, n_classes] of a trained classifier of that name."""
    return jax.nn.softmax(model(feature_of(descriptors, name)))


class Joined(NamedTuple):
    """The more confident classifier's answer, one a cloud.

    Attributes:
        class_index: [B] int, the winning class.
        confidence: [B] float, its probability.
        classifier: [B] str, the feature whose classifier won.
    """

    class_index: NDArray[np.intp]
    confidence: NDArray[np.floating[Any]]
    classifier: NDArray[np.str_]


def join(probabilities: Mapping[Feature, NDArray[np.floating[Any]]]) -> Joined:
    """The larger top-1 probability names the object (paper, "Recognition"); the first classifier wins a tie.

    Args:
        probabilities: feature -> [B, C] class probabilities of its classifier.
    """
    names = np.array(list(probabilities))
    stacked = np.stack([probabilities[name] for name in probabilities])  # [M, B, C]
    winner = stacked.max(axis=2).argmax(axis=0)
    chosen = stacked[winner, np.arange(stacked.shape[1])]
    return Joined(chosen.argmax(axis=1), chosen.max(axis=1), names[winner])
