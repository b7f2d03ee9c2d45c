"""Folded reductions against plain ones of NumPy in float64."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thor2_jax.descriptor.reductions import ROWS, argmax, fold, largest, smallest, total

LENGTHS = [16, 32, 48, 2048]
REDUCTIONS: dict[str, tuple[Callable[[jax.Array], jax.Array], Callable[..., np.ndarray]]] = {
    "total": (total, np.sum),
    "largest": (largest, np.max),
    "smallest": (smallest, np.min),
}


def numbers(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@jax.jit
def both_ways(values: jax.Array) -> dict[str, tuple[jax.Array, jax.Array]]:
    """Compute each reduction directly and under vmap, in one compiled function."""
    return {name: (function(values), jax.vmap(function)(values)) for name, (function, _) in REDUCTIONS.items()}


@pytest.mark.parametrize("length", LENGTHS)
def test_against_numpy(length: int) -> None:
    values = numbers(3, length, seed=length)
    for name, results in both_ways(values).items():
        expected = REDUCTIONS[name][1](values.astype(np.float64), axis=-1)
        for result in results:
            assert result.shape == (3,) and result.dtype == jnp.float32
            np.testing.assert_allclose(result, expected, rtol=0, atol=2e-7 * length if name == "total" else 0)


@pytest.mark.parametrize("name", REDUCTIONS)
@pytest.mark.parametrize("shape", [(16,), (0, 16), (2, 0, 16), (2, 3, 32)])
def test_any_leading_axes_without_jit(name: str, shape: tuple[int, ...]) -> None:
    plain, oracle = REDUCTIONS[name]
    result = plain(jnp.asarray(numbers(*shape)))
    expected = oracle(numbers(*shape).astype(np.float64), axis=-1)
    assert result.shape == shape[:-1]
    np.testing.assert_allclose(result, expected, atol=1e-5)


def test_infinities_and_ties() -> None:
    """Each entry in turn determines the result; all others are masked."""
    for fill, name in ((-np.inf, "largest"), (np.inf, "smallest"), (0.0, "total")):
        values = np.full((48, 48), fill, np.float32)
        np.fill_diagonal(values, np.arange(48) - 20)
        np.testing.assert_array_equal(both_ways(values)[name][0], np.arange(48) - 20)
        np.testing.assert_array_equal(both_ways(np.full((48, 48), fill, np.float32))[name][0], np.full(48, fill))
    np.testing.assert_array_equal(both_ways(np.full((48, 48), 2.5, np.float32))["largest"][0], np.full(48, 2.5))


@pytest.mark.parametrize("length", [16, 48])
def test_fold_combines_entries_a_row_apart(length: int) -> None:
    values = numbers(2, length)
    expected = values.astype(np.float64).reshape(2, ROWS, length // ROWS)
    for op, oracle in ((jnp.add, np.sum), (jnp.minimum, np.min)):
        folded = fold(jnp.asarray(values), op)
        assert folded.shape == (2, length // ROWS)
        np.testing.assert_allclose(folded, oracle(expected, axis=1), atol=1e-5)


@pytest.mark.parametrize("length", [1, 15, 17, 47])
def test_lengths_that_are_not_multiples_are_rejected(length: int) -> None:
    for function in (total, largest, smallest):
        with pytest.raises(TypeError):
            function(jnp.zeros((2, length)))


FEW = (*range(1, 21), 24, 32, 33, 40, 48, 64, 66, 80, 96, 112, 127, 128, 130)
"""Lengths that can be halved 0 to 4 times, to odd and to even ones."""


@pytest.fixture(scope="module", params=[FEW, pytest.param(range(1, 131), marks=pytest.mark.slow)], ids=["few", "all"])
def argmaxes(request: pytest.FixtureRequest) -> Callable[[np.ndarray], dict[int, np.ndarray]]:
    """Map a length to `argmax` over that many first entries of each row of an [8, 130] array, compiled together."""
    compiled = jax.jit(lambda values: {length: argmax(values[:, :length]) for length in request.param})
    return lambda values: {length: np.asarray(index) for length, index in compiled(values).items()}


def test_argmax_of_any_length(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    values = numbers(8, 130)
    for length, index in argmaxes(values).items():
        assert index.shape == (8,) and index.dtype == np.int32
        np.testing.assert_array_equal(index, values[:, :length].argmax(axis=1))


def test_argmax_in_every_place(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    for start in range(0, 123, 8):
        values, place = np.full((8, 130), -np.inf, np.float32), start + np.arange(8)
        values[np.arange(8), place] = -3.0
        for length, index in argmaxes(values).items():
            np.testing.assert_array_equal(index[place < length], place[place < length])
            assert (0 <= index).all() and (index < length).all()


def test_argmax_of_ties_is_one_of_them(argmaxes: Callable[[np.ndarray], dict[int, np.ndarray]]) -> None:
    values = np.random.default_rng(1).integers(0, 3, (8, 130)).astype(np.float32)
    values[0], values[1] = 0, -np.inf
    for length, index in argmaxes(values).items():
        assert (0 <= index).all() and (index < length).all()
        np.testing.assert_array_equal(values[np.arange(8), index], values[:, :length].max(axis=1))


def test_argmax_under_vmap_and_without_other_axes() -> None:
    values = numbers(2, 3, 66)
    compiled = jax.jit(lambda x: (argmax(x), jax.vmap(argmax)(x), jax.vmap(jax.vmap(argmax))(x), argmax(x[1, 2])))
    *indices, last = compiled(values)
    for index in indices:
        np.testing.assert_array_equal(index, values.argmax(axis=-1))
    assert last.shape == () and int(last) == values[1, 2].argmax()
    assert int(argmax(jnp.asarray([3.0, 5.0, 4.0]))) == 1  # not compiled


@pytest.mark.parametrize("name", REDUCTIONS)
def test_gradients_against_finite_differences(name: str) -> None:
    """Compare with differences of the NumPy function in float64, away from ties."""
    plain, oracle = REDUCTIONS[name]
    values = np.random.default_rng(0).permuted(np.tile(np.linspace(-1, 1, 48), (2, 1)), axis=1)
    weights = np.array([2.0, -0.5])
    gradient = jax.jit(jax.grad(lambda x: (plain(x) * jnp.asarray(weights, jnp.float32)).sum()))
    expected, step = np.zeros_like(values), 1e-4
    for place in np.ndindex(*values.shape):
        moved = np.zeros_like(values)
        moved[place] = step
        change = oracle(values + moved, axis=-1) - oracle(values - moved, axis=-1)
        expected[place] = weights @ change / (2 * step)
    np.testing.assert_allclose(gradient(values.astype(np.float32)), expected, atol=1e-6)


def test_gradients_of_ties_sum_to_one() -> None:
    values = numbers(48)
    values[5], values[[7, 20, 21, 40]] = -np.inf, 9.0
    gradient = np.asarray(jax.jit(jax.grad(largest))(values))
    assert set(np.flatnonzero(gradient)) <= {7, 20, 21, 40}
    assert gradient.sum() == pytest.approx(1) and gradient.min() == 0
