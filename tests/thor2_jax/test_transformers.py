"""The scikit-learn transformers: values of `describe`, scikit-learn's own checks, bad input."""

import dataclasses
import pickle
import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
from refusals import assert_refused
from sklearn.base import clone
from sklearn.pipeline import make_pipeline
from sklearn.utils import estimator_checks
from small_clouds import CLOSED, NETWORK, random_clouds
from small_runs import SMALL_CONFIG

import thor2_jax as thor2
from thor2_jax import transformers

TRANSFORMERS = (thor2.TopsTransformer, thor2.Tops2Transformer)
SIZES = (256, 191, 153, 81, 92)


# The other checks of `check_estimator` fit estimators to matrices of numbers [samples, features], which are no clouds;
# `check_estimator` itself leaves all checks out for estimators whose input is no matrix.
CHECKS = """
    do_not_raise_errors_in_init_or_set_params estimator_cloneable estimator_repr estimator_tags_renamed
    get_params_invariance mixin_order no_attributes_set_in_init parameters_default_constructible set_params
    valid_tag_types
""".split()


@pytest.mark.parametrize("transformer", TRANSFORMERS)
@pytest.mark.parametrize("check", CHECKS)
def test_checks_of_scikit_learn(check: str, transformer: Any) -> None:
    getattr(estimator_checks, f"check_{check}")(transformer.__name__, transformer())


@pytest.mark.parametrize("config", [SMALL_CONFIG, None])
def test_values_are_those_of_describe(config: thor2.DescriptorConfig | None) -> None:
    """The default is the configuration of the paper."""
    clouds = random_clouds(0, [*SIZES, 0, 0, 0])
    expected = thor2.describe(thor2.PointClouds.pack(clouds), NETWORK, config or CLOSED)
    for transformer, values in zip(TRANSFORMERS, (expected.tops, expected.tops2), strict=True):
        rows = transformer(config=config).fit_transform(clouds[:5])
        assert isinstance(rows, np.ndarray) and rows.dtype == np.float32
        np.testing.assert_allclose(rows, values[:5], atol=1e-6)


def test_more_clouds_than_the_largest_batch_with_another_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transformers, "BATCH_BUCKETS", (1, 2, 4))
    network = dataclasses.replace(NETWORK, similarity=np.eye(NETWORK.n_regions))
    one = random_clouds(0, SIZES)
    expected = thor2.describe(thor2.PointClouds.pack(one), network, SMALL_CONFIG).tops2
    pipeline = make_pipeline(thor2.Tops2Transformer(config=SMALL_CONFIG, network=network))  # needs no fit
    np.testing.assert_allclose(pipeline.transform(one * 3), np.tile(expected, (3, 1)), atol=1e-6)


def test_shape_needs_no_colors() -> None:
    clouds = random_clouds(0, [*SIZES[:3], 0])
    transformer = thor2.TopsTransformer(config=SMALL_CONFIG)
    expected = transformer.transform(clouds)
    assert not expected[3].any() and expected[:3].any(axis=1).all()
    np.testing.assert_array_equal(transformer.transform([xyz for xyz, _ in clouds]), expected)
    same_size = np.stack([clouds[0][0]] * 2)
    np.testing.assert_allclose(transformer.transform(same_size), expected[[0, 0]], atol=1e-6)
    np.testing.assert_array_equal(transformer.transform(tuple(xyz for xyz, _ in clouds[:2])), expected[:2])
    assert_refused("X is two arrays", transformer.transform, (clouds[0][0], np.random.rand(*clouds[0][0].shape)))


@pytest.mark.parametrize("transformer", TRANSFORMERS)
def test_columns_of_data_frames_follow_the_layout(transformer: Any) -> None:
    images = np.zeros((1, 2, 8, 8), object)
    colors = np.zeros((1, 2, NETWORK.n_regions, 5), object)
    for s, b, p in np.ndindex(2, 8, 8):
        images[0, s, b, p] = f"slice{s}_birth{b}_persistence{p}"
    for s, r, j in np.ndindex(2, NETWORK.n_regions, 5):
        colors[0, s, r, j] = f"slice{s}_region{r}_strip{j}"
    blocks = [images.reshape(2, -1)] + [colors.reshape(2, -1)] * (transformer is thor2.Tops2Transformer)
    clouds, plain = random_clouds(0, SIZES[:3]), transformer(config=SMALL_CONFIG)
    copy = clone(plain).set_params(capacity=512).set_output(transform="pandas").fit(clouds)
    copy = pickle.loads(pickle.dumps(copy))
    assert copy.get_params() == plain.get_params() | {"capacity": 512}
    frame = copy.transform(clouds)
    assert isinstance(frame, pd.DataFrame)
    assert list(frame.columns) == list(np.concatenate(blocks, axis=1).reshape(-1))
    np.testing.assert_array_equal(frame.to_numpy(), plain.transform(clouds))


XYZ, RGB = np.zeros((3, 3)), np.zeros((3, 3), np.uint8)
INVALID: list[tuple[str, Any, dict[str, Any]]] = [
    ("X is of type int", 7, {}),
    ("X is of type str", "cloud", {}),
    ("X is empty", [], {}),
    ("X[1] is of type int", [(XYZ, RGB), 7], {}),
    ("X[1]: xyz[2] is [nan, nan, nan]", [(XYZ, RGB), (np.array([[0.0] * 3] * 2 + [[np.nan] * 3]), RGB)], {}),
    ("X[0]: xyz has rows of different lengths", [([[0.0, 1.0, 2.0], [0.0]], RGB)], {}),
    ("X[1] has 8193 points", [(XYZ, RGB), (np.zeros((8193, 3)), np.zeros((8193, 3)))], {}),
    ("larger capacity", [(XYZ, RGB)], {"capacity": np.array([2])[0]}),  # as a grid search over an array gives it
    ("config is 'paper'", [(XYZ, RGB)], {"config": "paper"}),
    *((f"capacity is {value!r}", [(XYZ, RGB)], {"capacity": value}) for value in (0, 2.5, True)),
    ("network is 3", [(XYZ, RGB)], {"network": 3}),
]


def test_bad_input_is_refused() -> None:
    for message, clouds, options in INVALID:
        for method in ("fit", "transform"):
            transformer = thor2.Tops2Transformer(**{"config": SMALL_CONFIG} | options)
            assert_refused(re.escape(message), getattr(transformer, method), clouds)


@pytest.mark.parametrize("transformer", TRANSFORMERS)
def test_millimetres_give_a_warning(transformer: Any) -> None:
    clouds = random_clouds(0, SIZES[:2])
    with pytest.warns(UserWarning, match=r"^X\[1\] is .* millimetres"):
        transformer(config=SMALL_CONFIG).transform([clouds[0], (clouds[1][0] * 1000, clouds[1][1])])
