"""Fitting: it learns what can be learnt, the same way every time, and says so when it cannot."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

import colornet
import thor2_jax as thor2
from thor2_jax.classifier import MLP, feature_of
from training.dataset import StripDataset
from training.fit import EpochFigures, FitOptions, fit

NETWORK = colornet.load_default()
CONFIG = thor2.DescriptorConfig(n_slices=2, n_strips=5, image_size=12)  # small, so that it is quick
QUICK = FitOptions(epochs=12, batch_size=16, seed=3)


def separable(n: int = 48) -> StripDataset:
    """Three classes: short strips of one colour, long ones of the same, long ones of another."""
    rng = np.random.default_rng(0)
    labels = np.arange(n, dtype=np.int32) % 3
    shape = (n, 2, 5)
    length = np.where(labels == 0, 0.05, 0.2)[:, None, None] + rng.random(shape) * 0.01
    color = rng.random((*shape, 22)) * 0.1
    color[labels == 2, ..., 3] += 10
    color[labels != 2, ..., 8] += 10
    strips = thor2.Strips(
        low=np.zeros(shape, np.float32),
        high=length.astype(np.float32),
        occupied=np.ones(shape, bool),
        color=color.astype(np.float32),
        overflow=np.zeros(n, np.int32),
    )
    return StripDataset(strips, labels, np.arange(n, dtype=np.int32), ("a", "b", "c"))


def predict(model: MLP, data: StripDataset, feature: str) -> np.ndarray:
    strips = jax.tree.map(jnp.asarray, data.strips)
    return np.asarray(model(feature_of(thor2.describe_strips(strips, NETWORK, CONFIG), feature)))


@pytest.fixture(scope="module")
def learned() -> tuple[MLP, list[EpochFigures]]:
    curve: list[EpochFigures] = []
    return fit(separable(), NETWORK, CONFIG, "tops2", QUICK, curve.append), curve


def test_learns_to_tell_separable_classes_apart(learned: tuple[MLP, list[EpochFigures]]) -> None:
    model, curve = learned
    data = separable()
    assert (predict(model, data, "tops2").argmax(axis=1) == data.labels).mean() == 1.0
    assert [figures.epoch for figures in curve] == list(range(1, 13))
    assert curve[-1].loss < curve[0].loss / 3 and curve[-1].accuracy > 0.8
    assert all(isinstance(figures, EpochFigures) and math.isfinite(figures.loss) for figures in curve)


@pytest.mark.slow
def test_a_feature_sees_no_more_than_its_descriptor() -> None:
    """Shape cannot tell class 1 from 2, colour cannot tell 0 from 1."""
    data = separable()
    shape, color = (fit(data, NETWORK, CONFIG, name, QUICK) for name in ("tops", "ce"))
    tops, ce = predict(shape, data, "tops").argmax(axis=1), predict(color, data, "ce").argmax(axis=1)
    np.testing.assert_array_equal(tops == 0, data.labels == 0)
    np.testing.assert_array_equal(ce == 2, data.labels == 2)


def leaves(model: MLP) -> list[np.ndarray]:
    return [np.asarray(a) for a in jax.tree.leaves(nnx.to_pure_dict(nnx.state(model)))]


def test_the_same_seed_gives_the_same_bits(learned: tuple[MLP, list[EpochFigures]]) -> None:
    curve: list[EpochFigures] = []
    again = fit(separable(), NETWORK, CONFIG, "tops2", QUICK, curve.append)
    assert curve == learned[1]
    assert len(leaves(again)) > 20
    for a, b in zip(leaves(again), leaves(learned[0]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_another_seed_gives_another_classifier(learned: tuple[MLP, list[EpochFigures]]) -> None:
    other = fit(separable(), NETWORK, CONFIG, "tops2", dataclasses.replace(QUICK, seed=4))
    assert np.abs(other.head.kernel[...] - learned[0].head.kernel[...]).max() > 1e-3


def test_inputs_are_scaled_block_by_block_to_a_root_mean_square_of_one(
    learned: tuple[MLP, list[EpochFigures]],
) -> None:
    found = thor2.describe_strips(jax.tree.map(jnp.asarray, separable().strips), NETWORK, CONFIG)
    blocks = (np.asarray(learned[0].input_scale[...]) * np.asarray(found.tops2)).reshape(48, 2, 144 + 110)
    for block in (blocks[..., :144], blocks[..., 144:]):
        assert np.sqrt((block.astype(np.float64) ** 2).mean()) == pytest.approx(1, rel=1e-4)


def test_the_dataset_is_left_alone_and_a_small_one_is_one_batch() -> None:
    data = separable(5)
    before = jax.tree.map(np.copy, (data.strips, data.labels))
    curve: list[EpochFigures] = []
    fit(data, NETWORK, CONFIG, "tops", FitOptions(epochs=1), curve.append)
    assert len(curve) == 1
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves((data.strips, data.labels)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    data = separable()
    broken = dataclasses.replace(data, strips=dataclasses.replace(data.strips, color=data.strips.color * np.nan))
    with pytest.raises(thor2.InputError, match="loss of ce is nan in epoch 1"):
        fit(broken, NETWORK, CONFIG, "ce", QUICK)


def test_too_little_to_learn_from() -> None:
    data = separable()
    with pytest.raises(thor2.InputError, match=r"classes is \('a',\)"):
        fit(dataclasses.replace(data, classes=("a",)), NETWORK, CONFIG, "ce", QUICK)
    with pytest.raises(thor2.InputError, match="dataset has 1 sample"):
        fit(separable(1), NETWORK, CONFIG, "ce", QUICK)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("epochs", value) for value in (0, -1, 1.5, "3", True)],
        *[("batch_size", value) for value in (1, 0, 2.0, None)],
        *[("seed", value) for value in (-1, 0.5, 2**31)],
        *[("learning_rates", value) for value in ((1e-2,), (0, 1e-3), (1e-2, -1), (math.nan, 1.0), (math.inf, 1.0))],
    ],
)
def test_bad_options_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(thor2.InputError) as caught:
        FitOptions(**{name: value})
    assert str(caught.value).startswith(f"{name} is {value!r}; it must be")
    assert "\n" not in str(caught.value)


def test_the_papers_options() -> None:
    options = FitOptions(seed=2**31 - 1)
    assert options.epochs == 100 and options.learning_rates == (1e-2, 1e-3)
    jax.random.key(options.seed)
