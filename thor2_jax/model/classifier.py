"""The classifiers (paper, section "Recognition"): one MLP for each kind of descriptor.

Those of a run are compiled functions by name, from descriptors to class probabilities. The weights of Flax modules are
stored as named arrays in safetensors files.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, Literal, Self, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.descriptor.looks import LookDescriptors
from thor2_jax.errors import InputError
from thor2_jax.types import Descriptors

__all__ = [
    "EMBEDDING",
    "FEATURES",
    "HIDDEN",
    "THOR2",
    "Classifier",
    "Feature",
    "MLP",
    "RunClassifiers",
    "check_features",
    "class_probabilities",
    "compiled",
    "feature_of",
    "model_arrays",
    "model_from_arrays",
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

Module = TypeVar("Module", bound=nnx.Module)

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


def compiled(
    function: Callable[..., jax.Array], models: Sequence[tuple[Any, Any]], *static: Any
) -> Callable[[LookDescriptors], jax.Array]:
    """Return the compiled `function(modules, descriptors, *static)` as a function of the descriptors of looks.

    Models of the same sizes share the programs. JAX would take a state apart and hash each graph, in Python, at every
    call, which takes 4 % of the time of a frame: the weights are a flat list, and the graphs no argument.

    Args:
        function: of a module.
        models: graph and state of each module, from `nnx.split`.
        static: hashable.
    """
    graphs, states = zip(*models, strict=True)
    leaves, structure = jax.tree.flatten(states)
    return partial(_compiled(function, graphs, structure, static), leaves)


@lru_cache(maxsize=32)
def _compiled(
    function: Callable[..., jax.Array], graphs: tuple[Any, ...], structure: Any, static: tuple[Any, ...]
) -> Callable[[list[jax.Array], LookDescriptors], jax.Array]:
    @jax.jit
    def call(leaves: list[jax.Array], oriented: LookDescriptors) -> jax.Array:
        return function([*map(nnx.merge, graphs, jax.tree.unflatten(structure, leaves))], oriented, *static)

    return call


def _variables(model: nnx.Module) -> tuple[Any, dict[str, Any]]:
    """Return the state of the parameters and batch statistics, and its variables by their paths."""
    state = nnx.state(model, (nnx.Param, nnx.BatchStat))
    return state, {"/".join(map(str, path)): variable for path, variable in nnx.to_flat_state(state)}


def model_arrays(model: nnx.Module) -> dict[str, NDArray[Any]]:
    """Return the parameters and batch statistics of a model by their paths, for example layers/0/kernel."""
    return {name: np.asarray(variable[...]) for name, variable in _variables(model)[1].items()}


def model_from_arrays(create: Callable[[], Module], arrays: Mapping[str, NDArray[Any]]) -> Module:
    """Create a model with the given parameters and batch statistics; no weights are drawn.

    Args:
        create: function without arguments that constructs the model, its random generators included.
        arrays: arrays by name, as `model_arrays` returns them.

    Raises:
        ValueError: if an array is missing or has another shape.
    """
    model = nnx.eval_shape(create)
    state, variables = _variables(model)
    for name, variable in variables.items():
        if name not in arrays or arrays[name].shape != variable.shape:
            raise ValueError(f"{name} is missing or does not have the shape {variable.shape}")
        variable.set_value(jax.device_put(arrays[name]))  # `asarray` compiles a program for each shape
    nnx.update(model, state)
    return model
