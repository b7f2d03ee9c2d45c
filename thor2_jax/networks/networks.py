"""The networks of classifiers and embeddings, their compilation, and their weights as named arrays.

A classifier (paper, section "Recognition") is an MLP on one kind of descriptor, a feature, and is named by it. The
weights of Flax modules are stored as named arrays in safetensors files.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Literal, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.looks import N_BALANCED, N_SCALARS, LookDescriptors
from thor2_jax.descriptor.slicing import square_root
from thor2_jax.errors import InputError
from thor2_jax.types import HIGHEST, Descriptors, matmul

__all__ = [
    "EMBEDDING",
    "FEATURES",
    "HIDDEN",
    "MLP",
    "THOR2",
    "Classifier",
    "Compiled",
    "EmbeddingNetwork",
    "EmbeddingSizes",
    "Feature",
    "check_features",
    "class_cosines",
    "feature_of",
    "input_size",
    "model_arrays",
    "model_from_arrays",
    "projected_features",
    "to_unit_length",
]

Module = TypeVar("Module", bound=nnx.Module)

Feature = Literal["ce", "tops", "tops2"]
FEATURES: tuple[Feature, ...] = ("ce", "tops", "tops2")
"""Descriptors that a classifier can be trained on: colour embeddings, TOPS, TOPS2."""

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose fusion is THOR2."""

EMBEDDING = "embedding"
"""Name of the embedding as a classifier, beside the MLPs."""

Classifier = Callable[[LookDescriptors], jax.Array]
"""Function from the descriptors of K looks at B clouds to class probabilities [B, C], with sums of at most 1."""


def check_features(names: object) -> tuple[Feature, ...]:
    """Return `names` as a tuple of known features in the order of FEATURES.

    Raises:
        InputError: a name is unknown or given twice, or no name is given.
    """
    values = tuple(names) if isinstance(names, (list, tuple)) else ()
    if not values or len(set(values)) != len(values) or not set(values) <= set(FEATURES):
        raise InputError(f"classifiers is {names!r}; expected one or more of {', '.join(FEATURES)}")
    return tuple(name for name in FEATURES if name in values)


def feature_of(descriptors: Descriptors, name: Feature) -> jax.Array:
    """Return the flat descriptor [B, F] that the classifier of this name reads."""
    return {"ce": descriptors.color, "tops": descriptors.tops, "tops2": descriptors.tops2}[name]


def input_size(feature: Feature, config: DescriptorConfig, n_regions: int) -> int:
    """Return the number of floats in a descriptor."""
    image, embedding = config.image_size**2, n_regions * config.n_strips
    return config.n_slices * {"ce": embedding, "tops": image, "tops2": image + embedding}[feature]


HIDDEN = (512, 256, 128, 64)

Linear = partial(nnx.Linear, precision=HIGHEST)

SPARSE_BATCH = 16
"""Largest batch whose first layer uses `_sparse_matmul`. Small batches take as long as reading the weights, about four
fifths of which belong to inputs that are zero in every cloud of a frame."""


@jax.custom_jvp
def _sparse_matmul(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """Return `x @ kernel`, [B, F] times [F, H], reading only the rows of `kernel` where `x` has a non-zero entry.

    The rows are gathered into an array with a tenth or a quarter of F rows. If this is too small, the full product is
    computed.
    """
    needed = (x != 0).any(axis=0)
    capacities = [-(-len(needed) // divisor) for divisor in (10, 4)]

    def gathered(capacity: int) -> jax.Array:
        row = jnp.nonzero(needed, size=capacity, fill_value=len(needed))[0]
        entries = x.at[:, row].get(mode="fill", fill_value=0)
        return matmul(entries, kernel.at[row].get(mode="clip"))

    too_small = (needed.sum() > jnp.array(capacities)).sum()
    return jax.lax.switch(too_small, [*[partial(gathered, n) for n in capacities], lambda: matmul(x, kernel)])


@_sparse_matmul.defjvp
def _sparse_matmul_jvp(primals: Any, tangents: Any) -> Any:
    # A zero entry adds nothing to the product, but its derivative is not zero.
    (x, kernel), (x_dot, kernel_dot) = primals, tangents
    return _sparse_matmul(x, kernel), matmul(x_dot, kernel) + matmul(x, kernel_dot)


class MLP(nnx.Module):
    """Multi-layer perceptron with 512, 256, 128 and 64 hidden units and one logit for each class.

    Each hidden layer is followed by batch normalization, ReLU and dropout of 0.2. Inputs are first multiplied by
    `input_scale`, a constant computed from the training set. Without it, the first step of Adam would depend only on
    the colour counts, which are a thousand times as large as the images.
    """

    def __init__(self, n_inputs: int, n_classes: int, *, rngs: nnx.Rngs, dropout: float = 0.2) -> None:
        """Initialize the weights for inputs [B, n_inputs] and logits [B, n_classes]."""
        sizes = (n_inputs, *HIDDEN)
        self.input_scale = nnx.BatchStat(jnp.ones(n_inputs))
        self.layers = nnx.List([Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.norms = nnx.List([nnx.BatchNorm(n, momentum=0.9, rngs=rngs) for n in HIDDEN])
        self.dropout = nnx.Dropout(dropout)
        self.head = Linear(HIDDEN[-1], n_classes, rngs=rngs)

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


IMAGE_SHARE = 0.5
BLOCK_WEIGHTS = (1.0, 1.0, 1.0), (1.0, 2.0), (0.5, 2 + IMAGE_SHARE)
"""BLOCK_WEIGHTS: weights of the blocks in the similarity by `EmbeddingSizes.version`, before division by their sum.
IMAGE_SHARE: weight of the persistence images in the projected block; colours have 1. Chosen on held-out frames."""


@dataclasses.dataclass(frozen=True)
class EmbeddingSizes:
    """Sizes of an embedding's network, and the parts of its output.

    Attributes:
        cell: outputs of the layer that is shared by all strip positions.
        hidden: units of the hidden layers.
        learned: length of the network's block of the embedding.
        color: length of the block of projected colours and images.
        balanced: whether that block has the histogram of balanced colours; False in embeddings of earlier versions.
        shape: whether that block has the persistence images; False in embeddings of earlier versions.
        nearest: whether every distractor gets the logit of the nearest distractor, for each network and look; False in
            embeddings of earlier versions, where each distractor keeps its own logit.
        views: whether classification also uses the reference views; False in embeddings of earlier versions.
    """

    cell: int = 20
    hidden: tuple[int, ...] = (384, 256)
    learned: int = 128
    color: int = 120
    balanced: bool = True
    shape: bool = True
    nearest: bool = True
    views: bool = True

    @property
    def version(self) -> int:
        """Version of the projected features: 0 for strips, 1 with balanced colours, 2 with persistence images, too."""
        return self.balanced + (self.balanced and self.shape)


def to_unit_length(x: jax.Array) -> jax.Array:
    """Scale the last axis to unit length; zeros stay zeros."""
    return x * jax.lax.rsqrt(jnp.maximum(jnp.square(x).sum(axis=-1, keepdims=True), 1e-12))


class EmbeddingNetwork(nnx.Module):
    """Network of an embedding: one linear layer on each strip position of each slice, then fully connected layers.

    At each position, the layer reads the row of the persistence image with this birth, and the colour embedding of the
    strip. Empty positions contribute zero.
    """

    def __init__(
        self, config: DescriptorConfig, n_regions: int, sizes: EmbeddingSizes, n_proxies: int, *, rngs: nnx.Rngs
    ) -> None:
        """Initialize the weights; the colour basis is zero and the blocks have equal weights.

        Args:
            config: descriptor.
            n_regions: number of colour regions.
            sizes: sizes of the layers.
            n_proxies: number of proxies for classification; 0 for none.
            rngs: generators of the weights and the dropout.
        """
        self.positions = max(config.image_size, config.n_strips)
        self.n_regions, self.version = n_regions, sizes.version
        n_cells = config.n_slices * self.positions
        widths = (n_cells * sizes.cell + N_SCALARS + n_regions, *sizes.hidden)
        he = nnx.initializers.he_normal()
        self.cell = Linear(config.image_size + n_regions, sizes.cell, kernel_init=he, rngs=rngs)
        layers = [Linear(a, b, use_bias=False, kernel_init=he, rngs=rngs) for a, b in itertools.pairwise(widths)]
        self.layers = nnx.List(layers)
        self.norms = nnx.List([nnx.BatchNorm(n, momentum=0.9, rngs=rngs) for n in sizes.hidden])
        self.dropout = nnx.Dropout(0.15)
        self.head = Linear(sizes.hidden[-1], sizes.learned, use_bias=False, kernel_init=he, rngs=rngs)
        n_strips, cells = n_regions * config.n_strips, -(-config.image_size // 2)
        n_features = config.n_slices * n_strips, N_BALANCED, config.n_slices * cells**2  # each version adds one
        self.color_basis = nnx.BatchStat(jnp.zeros((sum(n_features[: sizes.version + 1]), sizes.color)))
        self.block_weights = nnx.BatchStat(jnp.array(BLOCK_WEIGHTS[sizes.version]))
        if n_proxies:
            self.proxies = nnx.Param(jax.random.normal(rngs.params(), (sizes.learned, n_proxies)))
            self.log_scale = nnx.Param(jnp.log(jnp.float32(16)))  # a weak type would compile the first steps twice

    def learned(
        self, descriptors: Descriptors, statistics: jax.Array, *, train: bool = False, rngs: nnx.Rngs | None = None
    ) -> jax.Array:
        """Return the learned block [B, learned], of unit length.

        Args:
            descriptors: descriptors of B clouds.
            statistics: [B, 12 + R] or more, from `cloud_statistics`; columns after the first 12 + R are ignored.
            train: normalize by the statistics of the batch, and drop units.
            rngs: generators of the dropout.
        """
        colors = jnp.swapaxes(square_root(descriptors.embeddings), -1, -2)
        cells = [100 * descriptors.images, 0.5 * colors]
        padded = [jnp.pad(a, ((0, 0), (0, 0), (0, self.positions - a.shape[2]), (0, 0))) for a in cells]
        bias = jnp.asarray(self.cell.bias)
        x = nnx.relu(self.cell(jnp.concatenate(padded, axis=-1))) - nnx.relu(bias)
        read = statistics[:, : N_SCALARS + self.n_regions]
        scale = jnp.where(jnp.arange(read.shape[1]) < N_SCALARS, 1, 2)
        x = jnp.concatenate([x.reshape(len(x), -1), read * scale], axis=1)
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = nnx.relu(norm(layer(x), use_running_average=not train))
            x = self.dropout(x, deterministic=not train, rngs=rngs)
        return to_unit_length(self.head(x))

    def class_logits(self, learned: jax.Array) -> jax.Array:
        """Return one logit for each proxy [B, n_proxies] from learned blocks [B, learned]."""
        return jnp.exp(self.log_scale[...]) * class_cosines(learned, self.proxies[...])

    def __call__(self, descriptors: Descriptors, statistics: jax.Array) -> jax.Array:
        """Return the embeddings [B, D], of unit length.

        The arguments are those of `learned`; with balanced colours, the last statistics are `balanced_histogram`.
        """
        features = projected_features(descriptors, statistics, self.version)
        blocks = [self.learned(descriptors, statistics), to_unit_length(matmul(features, self.color_basis[...]))]
        if self.version == 0:
            blocks.append(statistics[:, N_SCALARS : N_SCALARS + self.n_regions])
        weights = jnp.sqrt(self.block_weights[...])
        return to_unit_length(jnp.concatenate([w * block for w, block in zip(weights, blocks, strict=True)], axis=1))


def class_cosines(learned: jax.Array, proxies: jax.Array) -> jax.Array:
    """Return the cosines [B, n] of unit vectors [B, learned] with proxies [learned, n]."""
    return matmul(learned, proxies / jnp.linalg.norm(proxies, axis=0))


def projected_features(descriptors: Descriptors, statistics: jax.Array, version: int) -> jax.Array:
    """Return the features [B, F] that are projected to their principal components, by `EmbeddingSizes.version`.

    They are the square roots of the colour embeddings, `balanced_histogram` (the last columns of the statistics), and
    the square roots of the persistence images, averaged in cells of 2 x 2 pixels. Each part has a constant length.
    """
    count = len(descriptors.embeddings)
    parts = [to_unit_length(square_root(descriptors.embeddings).reshape(count, -1))]
    if version > 0:
        parts.append(statistics[:, -N_BALANCED:])
    if version > 1:
        cells = nnx.avg_pool(jnp.moveaxis(descriptors.images, 1, -1), (2, 2), strides=(2, 2), padding="SAME")
        parts.append(math.sqrt(IMAGE_SHARE) * to_unit_length(square_root(cells).reshape(count, -1)))
    return jnp.concatenate(parts, axis=1)


class Compiled:
    """The compiled `function(modules, inputs, *static)` as a function of the inputs, a pytree of arrays.

    Models of the same sizes share compiled programs. The weights are passed as a flat list and the graphs are no
    arguments, since flattening and hashing them at every call would take 4 % of the time of a frame. Another process
    that receives the function compiles it again.
    """

    def __init__(self, function: Callable[..., jax.Array], models: Sequence[tuple[Any, Any]], *static: Any) -> None:
        """Prepare the function.

        Args:
            function: function of the modules, the inputs and `static`.
            models: graph and state of each module, from `nnx.split`.
            static: further arguments, hashable.
        """
        self._arguments = function, models, *static
        graphs, states = zip(*models, strict=True)
        leaves, structure = jax.tree.flatten(states)
        self._call: Any = jax.tree_util.Partial(_compiled(function, graphs, structure, static), leaves)

    def __call__(self, inputs: Any) -> jax.Array:
        """Return the result for the inputs."""
        return self._call(inputs)

    def __reduce__(self) -> tuple[Any, ...]:
        return Compiled, self._arguments


# As an argument of a compiled function, it is a `Partial` of its weights, so that other weights compile nothing.
jax.tree_util.register_pytree_node(Compiled, lambda each: ((each._call,), None), lambda _, children: children[0])


@lru_cache(maxsize=32)
def _compiled(
    function: Callable[..., jax.Array], graphs: tuple[Any, ...], structure: Any, static: tuple[Any, ...]
) -> Callable[[list[jax.Array], Any], jax.Array]:
    @jax.jit
    def call(leaves: list[jax.Array], inputs: Any) -> jax.Array:
        return function([*map(nnx.merge, graphs, jax.tree.unflatten(structure, leaves))], inputs, *static)

    return call


def _variables(model: nnx.Module) -> tuple[Any, dict[str, Any]]:
    """Return the state of the parameters and batch statistics, and its variables by their paths."""
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return state, {"/".join(map(str, path)): variable for path, variable in nnx.to_flat_state(state)}


def model_arrays(model: nnx.Module, prefix: str = "") -> dict[str, NDArray[Any]]:
    """Return the parameters and batch statistics of a model by name: `prefix` and a path such as layers/0/kernel."""
    return {prefix + path: np.asarray(variable[...]) for path, variable in _variables(model)[1].items()}


def model_from_arrays(create: Callable[[], Module], arrays: Mapping[str, NDArray[Any]], prefix: str = "") -> Module:
    """Create a model with the given parameters and batch statistics; no weights are drawn.

    Args:
        create: function without arguments that constructs the model, its random generators included.
        arrays: arrays by name, as `model_arrays` returns them; others are ignored.
        prefix: prefix of the names.

    Raises:
        ValueError: an array is missing or has another shape.
    """
    model = nnx.eval_shape(create)
    state, variables = _variables(model)
    for path, variable in variables.items():
        name = prefix + path
        if name not in arrays or arrays[name].shape != variable.shape:
            raise ValueError(f"{name} is missing or does not have the shape {variable.shape}")
        variable.set_value(jax.device_put(arrays[name]))  # `asarray` compiles a program for each shape
    nnx.update(model, state)
    return model
