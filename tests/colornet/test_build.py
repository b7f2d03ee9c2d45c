"""The network built from scratch equals the packaged one and has the counts of the paper."""

import dataclasses
import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

import colornet
from colornet.builder import merge_redundant, relabel
from colornet.grid import grid_colors
from colornet.lab import GRID_WHITE, MEAN_WHITE, hyab, to_lab
from colornet.mapper import EPS, HyabDBSCAN

from .conftest import Rebuilt


@pytest.mark.slow
def test_packaged_network_is_the_result_of_build(rebuilt: Rebuilt, network: colornet.ColorNetwork) -> None:
    for field in dataclasses.fields(network):
        built, packaged = getattr(rebuilt.network, field.name), getattr(network, field.name)
        if np.asarray(packaged).dtype == np.float64:  # another processor may round a cube root differently
            np.testing.assert_allclose(built, packaged, rtol=1e-12, err_msg=field.name)
        else:
            np.testing.assert_array_equal(built, packaged, err_msg=field.name)
    assert rebuilt.network.fingerprint == network.fingerprint


@pytest.mark.slow
def test_build_takes_little_memory(rebuilt: Rebuilt) -> None:
    assert rebuilt.mebibytes < 3 * 1024


def test_regions_are_the_clusters_of_their_cubes(network: colornet.ColorNetwork) -> None:
    """Clusters of five cubes of the cover, found anew, are regions; one was merged with that of another cube."""
    lab = to_lab(grid_colors(), GRID_WHITE)
    regions = [np.flatnonzero(network.region_bits >> np.uint32(r) & 1) for r in range(network.n_regions)]
    equal_regions = []
    for cube in ((1, 0), (1, 1), (2, 3), (2, 5), (2, 7)):
        inside = [np.abs(values - center) <= half for values, center, half in intervals(lab, cube)]
        rows = np.flatnonzero(inside[0] & inside[1])
        labels = HyabDBSCAN().fit_predict(lab[rows])
        for cluster in (rows[labels == k] for k in range(labels.max() + 1)):
            equal_regions.append([r for r, members in enumerate(regions) if np.array_equal(cluster, members)])
    assert equal_regions == [[8], [9], [17], [], [19], [21]]


def intervals(lab: NDArray[np.float64], cube: tuple[int, int]) -> list[tuple[NDArray[np.float64], float, float]]:
    """Return chroma and hue of colours, with the centre and half the length of their intervals of a cube."""
    chroma = np.sqrt(lab[:, 1] ** 2 + lab[:, 2] ** 2)
    hue = np.arctan2(lab[:, 2], lab[:, 1]) + np.pi / 8
    out = []
    for values, n, overlap, k in ((chroma, 3, 0.10, cube[0]), (hue, 8, 0.25, cube[1])):
        length = np.ptp(values) / n
        out.append((values, values.min() + length * (k + 0.5), length / (2 * (1 - overlap))))
    return out


def test_counts(network: colornet.ColorNetwork) -> None:
    assert network.n_raw_nodes == 23
    assert network.n_regions == 22
    assert network.edges.shape == (55, 2)
    assert network.cyclic.sum() == 2
    assert network.edges[network.cyclic].tolist() == [[0, 7], [8, 15]]


@pytest.mark.slow
def test_exactly_one_pair_of_nodes_is_redundant(rebuilt: Rebuilt) -> None:
    colors, graph = grid_colors(), rebuilt.graph
    sets = [set(m.tolist()) for m in graph.members]
    means = to_lab(np.array([colors[m].mean(axis=0) for m in graph.members]), MEAN_WHITE)
    redundant = [
        (graph.names[i], graph.names[j], len(a & b), len(a), len(b), round(float(hyab(means[i], means[j])), 1))
        for i, a in enumerate(sets)
        for j, b in enumerate(sets[:i])
        if len(a & b) > 0.95 * min(len(a), len(b)) and hyab(means[i], means[j]) <= EPS
    ]
    assert redundant == [("cube19_cluster0", "cube18_cluster0", 841, 853, 1279, 4.4)]


@pytest.mark.slow
def test_regions_are_numbered_like_kmapper_nodes(rebuilt: Rebuilt) -> None:
    colors, graph = grid_colors(), rebuilt.graph
    members, region = merge_redundant(colors, graph.members, EPS)
    kept = [name for name in graph.names if name != "cube19_cluster0"]
    region_of_node = dict(zip(graph.names, region.tolist(), strict=True))
    assert [region_of_node[name] for name in kept] == list(range(22))
    assert region_of_node["cube19_cluster0"] == region_of_node["cube18_cluster0"]
    for r, rows in enumerate(members):
        np.testing.assert_array_equal(np.flatnonzero(rebuilt.network.region_bits >> np.uint32(r) & 1), rows)
    assert len(graph.members) == 23
    edges = rebuilt.network.edges[rebuilt.network.cyclic]
    assert relabel(graph.cyclic, region).tolist() == edges.tolist()


def test_edges_are_shared_colors_and_the_hue_cut(network: colornet.ColorNetwork) -> None:
    bits = network.region_bits
    sharing = [
        [i, j]
        for i in range(22)
        for j in range(i + 1, 22)
        if np.any((bits >> np.uint32(i)) & (bits >> np.uint32(j)) & np.uint32(1))
    ]
    assert network.edges[~network.cyclic].tolist() == sharing


@pytest.mark.slow
def test_every_node_lies_in_one_cube_of_the_cover(rebuilt: Rebuilt) -> None:
    """The cover has 3 x 8 intervals of equal length, each widened by its overlap, and hue is cut at xi - pi."""
    lab = to_lab(grid_colors(), GRID_WHITE)
    cubes = []
    for members in rebuilt.graph.members:
        place: list[set[int]] = [set(), set()]
        for cube in itertools.product(range(3), range(8)):
            for axis, (values, center, half) in enumerate(intervals(lab, cube)):
                low, high = values[members].min(), values[members].max()
                if center - half <= low and high <= center + half:
                    place[axis].add(cube[axis])
        assert all(place)
        cubes.append(place)
    cyclic_pairs = {(i, j) for i, j in rebuilt.graph.cyclic.tolist()}
    for i, j in cyclic_pairs:  # the two ends of the hue circle, in one chroma interval
        assert cubes[i][0] & cubes[j][0]
        assert {min(cubes[i][1]), max(cubes[j][1])} == {0, 7}
