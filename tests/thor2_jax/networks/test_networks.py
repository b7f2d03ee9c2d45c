"""The classifier against the same layers in NumPy, float64."""

import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from refusals import assert_refused
from slow_tier import slow

from thor2_jax.networks.networks import FEATURES, MLP, SPARSE_BATCH, check_features

RNG = np.random.default_rng(0)
apply = nnx.jit(lambda model, x: model(x))
train = nnx.jit(lambda model, x: model(x, train=True))


def loss(x: jax.Array, model: MLP, extra_rows: int) -> jax.Array:
    """Return a function of the logits of the rows of `x`, which are evaluated together with further rows of zeros."""
    return jnp.sin(model(jnp.pad(x, ((0, extra_rows), (0, 0))))[: len(x)]).sum()


gradient = nnx.jit(nnx.grad(loss), static_argnums=2)


@pytest.fixture(scope="module")
def model() -> MLP:
    """A classifier with random batch statistics and scales."""
    model = MLP(33, 5, rngs=nnx.Rngs(0))
    model.input_scale[...] = jnp.asarray(RNG.uniform(0.5, 2, 33), jnp.float32)
    for norm in model.norms:
        for values in (norm.mean, norm.bias):
            values[...] = jnp.asarray(RNG.normal(size=values.shape), jnp.float32)
        for values in (norm.var, norm.scale):
            values[...] = jnp.asarray(RNG.uniform(0.5, 2, values.shape), jnp.float32)
    return model


def numpy_logits(model: MLP, x: np.ndarray, own_statistics: bool) -> np.ndarray:
    x = x.astype(np.float64) * np.asarray(model.input_scale[...])
    for layer, norm in zip(model.layers, model.norms, strict=True):
        x = x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])
        mean, var = (x.mean(0), x.var(0)) if own_statistics else (np.asarray(norm.mean[...]), np.asarray(norm.var[...]))
        x = (x - mean) / np.sqrt(var + 1e-5) * np.asarray(norm.scale[...]) + np.asarray(norm.bias[...])
        x = np.maximum(x, 0)
    return x @ np.asarray(model.head.kernel[...]) + np.asarray(model.head.bias[...])


@pytest.mark.parametrize("n", [0, 1, SPARSE_BATCH, *slow(SPARSE_BATCH + 1)])
@pytest.mark.parametrize("n_used", [0, 1, 4, 5, 9, 10, 33])  # a tenth of 33, rounded up, is 4, and a quarter is 9
def test_logits_and_gradients_where_most_inputs_are_zero(n_used: int, n: int, model: MLP) -> None:
    x = np.zeros((n, 33), np.float32)
    x[:, RNG.permutation(33)[:n_used]] = RNG.normal(size=(n, n_used))
    expected = numpy_logits(model, x, own_statistics=False)
    np.testing.assert_allclose(apply(model, x), expected, rtol=1e-4, atol=1e-4)

    # More rows than SPARSE_BATCH, of which only the first count, switch off the sparse product.
    expected = np.asarray(gradient(x, model, SPARSE_BATCH + 1))
    assert n_used == 33 or n == 0 or np.abs(expected[x == 0]).min() > 0
    np.testing.assert_allclose(gradient(x, model, 0), expected, rtol=1e-3, atol=1e-4)


def test_the_papers_layers() -> None:
    model = MLP(40, 6, rngs=nnx.Rngs(0))
    shapes = [layer.kernel[...].shape for layer in [*model.layers, model.head]]
    assert shapes == [(40, 512), (512, 256), (256, 128), (128, 64), (64, 6)]
    assert model.dropout.rate == 0.2


def test_training_uses_batch_statistics_and_moves_running_ones() -> None:
    model = MLP(33, 5, rngs=nnx.Rngs(0), dropout=0.0)
    x = RNG.normal(size=(16, 33)).astype(np.float32)
    expected = numpy_logits(model, x, own_statistics=True)
    np.testing.assert_allclose(train(model, jnp.asarray(x)), expected, rtol=1e-3, atol=1e-3)
    first = x @ np.asarray(model.layers[0].kernel[...]) + np.asarray(model.layers[0].bias[...])
    np.testing.assert_allclose(model.norms[0].mean[...], 0.1 * first.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(model.norms[0].var[...], 0.9 + 0.1 * first.var(axis=0), atol=1e-5)


@pytest.mark.parametrize("names", [*itertools.permutations(FEATURES), ("tops",), ["tops2", "ce"]])
def test_features_come_in_one_order(names: object) -> None:
    assert check_features(names) == tuple(name for name in ("ce", "tops", "tops2") if name in names)  # type: ignore[operator]


@pytest.mark.parametrize("names", [(), [], ["tops", "tops"], ["shape"], "tops", None, ["tops", None], 3])
def test_bad_features_are_refused(names: object) -> None:
    assert_refused(rf"^classifiers is {re.escape(repr(names))}.*ce, tops, tops2", check_features, names)
