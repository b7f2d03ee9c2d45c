"""The classifiers (paper, section "Recognition"): one MLP for each kind of descriptor."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors

__all__ = [
    "EMBEDDING",
    "FEATURES",
    "HIDDEN",
    "Feature",
    "MLP",
    "check_features",
    "class_probabilities",
    "feature_of",
    "oriented_probabilities",
]

Feature = Literal["ce", "tops", "tops2"]
FEATURES: tuple[Feature, ...] = ("ce", "tops", "tops2")
"""Descriptors that a classifier can be trained on: colour embeddings, TOPS, TOPS2."""

EMBEDDING = "embedding"
"""Name of the class probabilities that the embedding of a run gives, beside those of the MLPs."""

HIDDEN = (512, 256, 128, 64)

SPARSE_BATCH = 16
"""Largest batch whose first layer uses `_sparse_matmul`: up to it, a classifier takes as long as reading its weights,
and about four fifths of them belong to inputs that are zero in every cloud of a frame."""


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


@jax.custom_jvp
def _sparse_matmul(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Return `x @ kernel`, [B, F] times [F, H], reading only the rows of `kernel` where `x` has a non-zero entry.

    The rows are gathered into an array of a tenth or a quarter of F. If more are needed, the plain product is computed.
    """
    needed = (x != 0).any(axis=0)
    capacities = [-(-len(needed) // divisor) for divisor in (10, 4)]

    def gathered(capacity: int) -> jax.Array:
        row = jnp.nonzero(needed, size=capacity, fill_value=len(needed))[0]
        entries = x.at[:, row].get(mode="fill", fill_value=0)
        return jnp.matmul(entries, kernel.at[row].get(mode="clip"))

    too_small = (needed.sum() > jnp.array(capacities)).sum()
    return jax.lax.switch(too_small, [*[partial(gathered, n) for n in capacities], lambda: jnp.matmul(x, kernel)])


@_sparse_matmul.defjvp
def _sparse_matmul_jvp(primals: Any, tangents: Any) -> Any:
    # A zero entry adds nothing to the product, but its derivative is not zero.
    (x, kernel), (x_dot, kernel_dot) = primals, tangents
    return _sparse_matmul(x, kernel), jnp.matmul(x_dot, kernel) + jnp.matmul(x, kernel_dot)


class MLP(nnx.Module):
    """Multi-layer perceptron with 512, 256, 128 and 64 hidden units and one logit for each class.

    Each hidden layer is followed by batch normalization, ReLU and dropout of 0.2. Inputs are first multiplied by
    `input_scale`, fixed numbers computed from the training set: images and colour counts differ a thousandfold, and the
    first step of Adam would depend on the counts only.
    """

    def __init__(self, n_inputs: int, n_classes: int, *, rngs: nnx.Rngs, dropout: float = 0.2) -> None:
        """Initialize the weights for inputs [B, n_inputs] and logits [B, n_classes]."""
        sizes = (n_inputs, *HIDDEN)
        self.input_scale = nnx.BatchStat(jnp.ones(n_inputs))
        self.layers = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.norms = nnx.List([nnx.BatchNorm(n, momentum=0.9, rngs=rngs) for n in HIDDEN])
        self.dropout = nnx.Dropout(dropout)
        self.head = nnx.Linear(HIDDEN[-1], n_classes, rngs=rngs)

    def __call__(self, x: jax.Array, *, train: bool = False, rngs: nnx.Rngs | None = None) -> jax.Array:
        """Return the logits [B, n_classes] of descriptors [B, n_inputs].

        With `train`, batch normalization uses the statistics of the batch, and dropout is drawn from `rngs`.
        """
        x = x * self.input_scale[...]
        for layer, norm in zip(self.layers, self.norms, strict=True):
            if layer is self.layers[0] and not train and len(x) <= SPARSE_BATCH:
                x = _sparse_matmul(x, layer.kernel[...]) + jnp.asarray(layer.bias)
            else:
                x = layer(x)
            x = nnx.relu(norm(x, use_running_average=not train))
            x = self.dropout(x, deterministic=not train, rngs=rngs)
        return self.head(x)


def class_probabilities(model: MLP, descriptors: Descriptors, name: Feature) -> jax.Array:
    """Return the class probabilities [B, n_classes] of a trained classifier that reads the descriptor `name`."""
    return jax.nn.softmax(model(feature_of(descriptors, name)))


def oriented_probabilities(model: MLP, oriented: LookDescriptors, name: Feature) -> jax.Array:
    """Return the class probabilities [B, n_classes] of clouds from the descriptors of K looks at them."""
    return oriented.fuse(model(feature_of(oriented.flat[0], name)))
