"""Packing of clouds and memory layout of descriptors."""

import dataclasses
import importlib
import pkgutil
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import assert_refused
from small_clouds import random_clouds

import colornet
import thor2_jax as thor2
from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.networks.networks import feature_of

RNG = np.random.default_rng(0)


def test_pack_pads_copies_of_every_size_and_unpack_undoes_it() -> None:
    sizes = (0, 1, 2, 7, 513)
    clouds, given = random_clouds(0, sizes), random_clouds(0, sizes)
    packed = thor2.PointClouds.pack(given)
    np.testing.assert_equal(given, clouds)
    for xyz, rgb in given:
        xyz[:], rgb[:] = 9, 9
    assert packed.points.shape == packed.colors.shape == (5, 1024, 3)
    assert packed.points.dtype == packed.colors.dtype == jnp.float32
    assert packed.mask.dtype == packed.boundary.dtype == jnp.bool_
    np.testing.assert_array_equal(packed.mask, np.arange(1024) < np.array(sizes)[:, None])
    assert not packed.points[~packed.mask].any()
    for (points, colors), (xyz, rgb) in zip(packed.unpack(), clouds, strict=True):
        np.testing.assert_array_equal(points, xyz)
        np.testing.assert_allclose(colors, rgb / 255, atol=1e-7)
    assert not packed.camera.any() and not packed.boundary.any() and packed.rim is None


def test_pack_takes_colors_capacity_camera_boundary_and_rim() -> None:
    cloud = RNG.random((5, 3)), RNG.random((5, 3))
    marks = np.array([True, False, True, False, False])
    padded = [[False] * 9, [*marks, *[False] * 4]]
    packed, on_host = (
        thor2.PointClouds.pack([cloud] * 2, 9, [1, 2, 3], [None, marks], rim=[None, marks], on_host=on_host)
        for on_host in (False, True)
    )
    for expected, actual in zip(list(vars(packed).values())[:6], vars(on_host).values(), strict=False):
        assert isinstance(expected, jax.Array) and isinstance(actual, np.ndarray)
        np.testing.assert_array_equal(actual, expected, strict=True)
    assert packed.points.shape == (2, 9, 3)
    np.testing.assert_array_equal(packed.colors[0, :5], cloud[1].astype(np.float32))
    np.testing.assert_array_equal(packed.camera, [[1, 2, 3]] * 2)
    np.testing.assert_array_equal(packed.boundary, padded)
    np.testing.assert_array_equal(packed.rim, padded)
    each = thor2.PointClouds.pack([cloud] * 2, camera=[[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(each.camera, [[1, 2, 3], [4, 5, 6]])


POINTS, COLORS = np.zeros((3, 3)), np.zeros((3, 3))


def changed(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array[1, 2] = value
    return array


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"clouds": []}, ["clouds is empty"]),
        ({"clouds": None}, ["clouds is of type NoneType"]),
        ({"clouds": [(POINTS, COLORS), (np.zeros((3, 2)), COLORS)]}, ["clouds[1]", "xyz", "[3, 2]"]),
        ({"clouds": [(np.zeros((3, 3), int), COLORS)]}, ["clouds[0]", "xyz", "int64"]),
        ({"clouds": [(POINTS, np.zeros((2, 3)))]}, ["clouds[0]", "rgb", "[2, 3]"]),
        ({"clouds": [(POINTS, np.zeros((3, 3), int))]}, ["clouds[0]", "rgb is int64"]),
        ({"clouds": [(changed(POINTS, np.nan), COLORS)]}, ["clouds[0]", "xyz[1]", "nan"]),
        ({"clouds": [(changed(POINTS, 1e39), COLORS)]}, ["clouds[0]", "xyz[1]", "1e+39"]),
        ({"clouds": [(POINTS, changed(COLORS, 1.5))]}, ["clouds[0]", "rgb[1]", "1.5"]),
        ({"clouds": [(POINTS, changed(COLORS, -0.5))]}, ["clouds[0]", "rgb[1]", "-0.5"]),
        ({"clouds": [POINTS]}, ["clouds[0]", "pair"]),
        ({"clouds": [(POINTS, COLORS, COLORS)]}, ["clouds[0]", "pair"]),
        ({"capacity": 2}, ["clouds[0]", "3", "at most 2, the capacity"]),
        ({"capacity": np.int64(2)}, ["at most 2, the capacity"]),
        ({"capacity": 0}, ["capacity is 0"]),
        ({"capacity": 8.0}, ["capacity is 8.0"]),
        ({"clouds": [(np.zeros((8193, 3)), np.zeros((8193, 3)))]}, ["clouds[0]", "8193", "8192"]),
        ({"camera": [0, 0]}, ["camera", "[0.0, 0.0]"]),
        ({"camera": [0, 0, np.inf]}, ["camera", "inf"]),
        ({"camera": np.zeros((2, 3))}, ["camera", "[1, 3]"]),
        ({"camera": "here"}, ["camera", "here"]),
        ({"camera": np.ma.masked_less([0.0, 1, 2], 1)}, ["camera", "masked"]),
        ({"boundary": []}, ["boundary", "0 entries", "1 clouds"]),
        ({"boundary": [np.zeros(2, bool)]}, ["boundary[0]", "[2]", "[3]"]),
        ({"boundary": [[[True], [True, False]]]}, ["boundary[0]", "different lengths"]),
        ({"boundary": [np.zeros(3)]}, ["boundary[0]", "float64"]),
        ({"boundary": True}, ["boundary", "bool", "1 clouds"]),
    ],
)
def test_pack_rejects(arguments: dict, expected: list[str]) -> None:
    given = {"clouds": [(POINTS, COLORS)], **arguments}
    assert_refused(".*".join(map(re.escape, expected)), thor2.PointClouds.pack, **given)


def test_layout_of_the_flat_descriptors_and_features() -> None:
    """TOPS2 has a block [image | embedding] for each slice, both flattened in C order."""
    images = RNG.random((2, 7, 32, 32)).astype(np.float32)
    embeddings = RNG.random((2, 7, 22, 31)).astype(np.float32)
    descriptors = thor2.Descriptors(jnp.asarray(images), jnp.asarray(embeddings), jnp.zeros(2, jnp.int32))
    blocks = [images.reshape(2, 7, 32 * 32), embeddings.reshape(2, 7, 22 * 31)]
    np.testing.assert_array_equal(feature_of(descriptors, "tops"), blocks[0].reshape(2, -1))
    np.testing.assert_array_equal(feature_of(descriptors, "ce"), blocks[1].reshape(2, -1))
    np.testing.assert_array_equal(feature_of(descriptors, "tops2"), np.concatenate(blocks, axis=2).reshape(2, -1))


def test_records_are_frozen() -> None:
    modules = [
        importlib.import_module(module.name)
        for package in (colornet, thor2)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    records = {item for module in modules for item in vars(module).values() if isinstance(item, type)}
    records = set(filter(dataclasses.is_dataclass, records))
    assert len(records) > 10
    for record in records:
        assert record.__dataclass_params__.frozen, record


RECORDS_OF_JAX = [thor2.PointClouds, thor2.Strips, thor2.Diagrams, thor2.Descriptors, thor2.Parameters]


@pytest.mark.parametrize("record", [PreparedInstance, thor2.RGBDFrame, *RECORDS_OF_JAX])
def test_records_of_arrays_compare_by_identity(record: type) -> None:
    """Comparing their arrays would raise."""
    assert record.__eq__ is object.__eq__ and record.__hash__ is object.__hash__
