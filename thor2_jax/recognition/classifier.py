"""The classifiers (paper, section "Recognition"): one MLP for each kind of descriptor."""

from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import nnx

from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors

__all__ = [
    "FEATURES",
    "HIDDEN",
    "Feature",
    "MLP",
    "check_features",
    "class_probabilities",
    "feature_of",
]

Feature = Literal["ce", "tops", "tops2"]
FEATURES: tuple[Feature, ...] = ("ce", "tops", "tops2")
"""What a classifier can be trained on: colour embeddings, TOPS, TOPS2."""

HIDDEN = (512, 256, 128, 64)


FEW = 16
"""Clouds up to which a classifier takes as long as reading its weights; of a frame's descriptors four fifths are 0."""


def check_features(names: object, argument: str) -> tuple[Feature, ...]:
    """`names` as a tuple of known features, in the order of FEATURES, or an InputError that names `argument`."""
    values = tuple(names) if isinstance(names, (list, tuple)) else ()
    if not values or len(set(values)) != len(values) or not set(values) <= set(FEATURES):
        raise InputError(f"{argument} is {names!r}; expected one or more different ones of {', '.join(FEATURES)}")
    return tuple(name for name in FEATURES if name in values)


def feature_of(descriptors: Descriptors, name: Feature) -> jax.Array:
    """The flat descriptor [B, F] that a classifier of this name reads."""
    return {"ce": descriptors.color, "tops": descriptors.tops, "tops2": descriptors.tops2}[name]


@jax.custom_jvp
def _product_of_sparse(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """`x @ kernel`, [B, F] and [F, H] to [B, H], from the rows of `kernel` that an entry of `x` other than 0 needs.

    There is room for a tenth of the rows, or a quarter. Where more are needed, it is the plain product.
    """
    needed = (x != 0).any(axis=0)
    rooms = [-(-len(needed) // part) for part in (10, 4)]

    def of_needed(room: int) -> jax.Array:
        row = jnp.nonzero(needed, size=room, fill_value=len(needed))[0]
        entries = x.at[:, row].get(mode="fill", fill_value=0)
        return jnp.matmul(entries, kernel.at[row].get(mode="clip"))

    too_small = (needed.sum() > jnp.array(rooms)).sum()
    return jax.lax.switch(too_small, [*[partial(of_needed, room) for room in rooms], lambda: jnp.matmul(x, kernel)])


@_product_of_sparse.defjvp
def _product_of_sparse_jvp(primals: Any, tangents: Any) -> Any:
    # An entry that is 0 adds nothing, but its derivative does.
    (x, kernel), (of_x, of_kernel) = primals, tangents
    return _product_of_sparse(x, kernel), jnp.matmul(of_x, kernel) + jnp.matmul(x, of_kernel)


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
            if layer is self.layers[0] and not train and len(x) <= FEW:
                x = _product_of_sparse(x, layer.kernel[...]) + jnp.asarray(layer.bias)
            else:
                x = layer(x)
            x = nnx.relu(norm(x, use_running_average=not train))
            x = self.dropout(x, deterministic=not train, rngs=rngs)
        return self.head(x)


def class_probabilities(model: MLP, descriptors: Descriptors, name: Feature) -> jax.Array:
    """Softmax [B, n_classes] of a trained classifier of that name."""
    return jax.nn.softmax(model(feature_of(descriptors, name)))
