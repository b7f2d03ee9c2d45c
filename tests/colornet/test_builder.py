"""The packaged network: a build from scratch, its parts on small cases, and its values from the colours alone."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from processes import finish_programs, start_program
from scipy.sparse.csgraph import floyd_warshall
from scipy.spatial.distance import cdist
from sklearn.cluster import DBSCAN

import colornet
from colornet.builder import EPS, MIN_SAMPLES, hyab_clusters, hyab_neighbors, merge_redundant, similarity
from colornet.colors import GRID_WHITE, MEAN_WHITE, grid_colors, hyab, to_lab

from .test_colors import NETWORK, reference_lab

BUILD = """
import re, sys, warnings
warnings.simplefilter("error")
from pathlib import Path
import colornet
colornet.build().save(sys.argv[1])
# The peak of getrusage is at least that of the parent process.
print(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
def test_packaged_network_is_built_in_little_memory(tmp_path: Path) -> None:
    (peak,) = finish_programs(start_program(BUILD, tmp_path / "network.npz"))
    assert int(peak) < 3 * 2**20
    rebuilt = colornet.load(tmp_path / "network.npz")
    for field in dataclasses.fields(NETWORK):
        built, packaged = getattr(rebuilt, field.name), getattr(NETWORK, field.name)
        if np.asarray(packaged).dtype == np.float64:  # another processor may round a cube root differently
            np.testing.assert_allclose(built, packaged, rtol=1e-12, err_msg=field.name)
        else:
            np.testing.assert_array_equal(built, packaged, err_msg=field.name)
    assert rebuilt.fingerprint == NETWORK.fingerprint


def reference_hyab(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return float(abs(one[0] - other[0]) + ((one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2) ** 0.5)


def path_lengths(n: int, edges: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of shortest paths by the algorithm of Floyd and Warshall."""
    graph = np.zeros((n, n))
    graph[tuple(edges.T)] = weights
    return floyd_warshall(graph, directed=False)


def test_values_follow_from_the_regions_of_the_colours() -> None:
    """Recompute counts, edges, means, their CIELAB, edge weights, paths and similarity.

    Regions that share colours are joined, and two pairs at the cut of the hue circle.
    """
    assert (NETWORK.n_raw_nodes, NETWORK.n_regions, len(NETWORK.edges)) == (23, 22, 55)
    assert NETWORK.edges[NETWORK.cyclic].tolist() == [[0, 7], [8, 15]]
    member = (NETWORK.region_bits[:, None] >> np.arange(22, dtype=np.uint32) & 1).astype(np.float64)
    np.testing.assert_array_equal(NETWORK.edges[~NETWORK.cyclic], np.argwhere(np.triu(member.T @ member, 1)))
    means = (member.T @ grid_colors()) / member.sum(axis=0)[:, None]
    np.testing.assert_allclose(NETWORK.mean_rgb, means, rtol=1e-13)
    lab = reference_lab(means, MEAN_WHITE)
    weights = np.array([reference_hyab(lab[i], lab[j]) for i, j in NETWORK.edges])
    np.testing.assert_allclose(NETWORK.edge_weights, weights, rtol=1e-11)
    expected = 1 / (1 + path_lengths(22, NETWORK.edges, weights))
    np.testing.assert_allclose(NETWORK.similarity, expected, rtol=1e-11)


def test_neighbourhoods_and_clusters_are_those_of_a_dense_matrix() -> None:
    """Of two blocks of similar colours and some random ones, and of colours on the border of the ball.

    For differences in lightness only, HyAB, the Euclidean distance and the radius are equal.
    """
    colors = grid_colors()
    rows = np.random.default_rng(0).choice(len(colors), 200, replace=False)
    for center in ([180, 90, 60], [40, 60, 200]):
        near = np.flatnonzero((np.abs(colors.astype(int) - center) <= 15).all(axis=1))[:200]
        rows = np.union1d(rows, near)
    some, border = to_lab(colors[rows], GRID_WHITE), np.array([[level, 3.0, 4.0] for level in (10, 17, 17.1, 24.1)])
    for lab, least in ((some, 1000), (border, 6)):
        distances = cdist(lab, lab, reference_hyab)
        near = (distances <= EPS) & ~np.eye(len(lab), dtype=bool)
        neighbors = hyab_neighbors(lab, EPS).toarray()
        assert near.sum() >= least
        np.testing.assert_array_equal(neighbors > 0, near)
        np.testing.assert_allclose(neighbors[near], distances[near], atol=1e-12)
        dense = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed").fit_predict(distances)
        labels = hyab_clusters(lab)
        assert labels.min() == -1 and (labels.max() >= 1) == (lab is some)
        np.testing.assert_array_equal(labels, dense)


def test_similarity_of_random_graphs() -> None:
    rng = np.random.default_rng(1)
    for n in (1, 2, 7, 13):
        pairs = np.array([(i, j) for i in range(n) for j in range(i + 1, n)], np.int64).reshape(-1, 2)
        edges = pairs[rng.random(len(pairs)) < 0.3]
        weights = rng.uniform(1, 100, len(edges))
        delta = similarity(n, edges, weights)
        np.testing.assert_allclose(delta, 1 / (1 + path_lengths(n, edges, weights)), rtol=1e-13)
        np.testing.assert_array_equal(delta, delta.T)


def test_only_nodes_with_shared_members_and_color_merge() -> None:
    """Use 40 greys and node sizes around the threshold of 95 % of the smaller node."""
    colors = np.repeat(np.arange(100, 140, dtype=np.uint8)[:, None], 3, axis=1)
    whole = np.arange(40)
    cases = {
        "apart": ([whole[:20], whole[20:]], [0, 1]),
        "19 of 20 are not more than 95 %": ([whole[:20], whole[1:22]], [0, 1]),
        "all of the smaller": ([whole[10:40], whole[20:40]], [0, 0]),
        "the first keeps its place": ([whole[:21], whole[35:], whole[:20], whole[30:34]], [0, 1, 0, 2]),
        "alone": ([whole], [0]),
    }
    for name, (members, expected) in cases.items():
        merged, region = merge_redundant(colors, members, eps=7.0)
        assert region.tolist() == expected, name
        for k, rows in enumerate(merged):
            union = set().union(*(m.tolist() for m, r in zip(members, expected, strict=True) if r == k))
            assert rows.tolist() == sorted(union), name


def test_nodes_with_mean_colors_at_the_limit_merge() -> None:
    colors = np.repeat(np.array([100, 110, 120], np.uint8)[:, None], 3, axis=1)
    members = [np.array([0]), np.array([0, 1, 2])]
    limit = float(hyab(*to_lab(np.array([[100.0] * 3, [110.0] * 3]), MEAN_WHITE)))
    for eps, regions in ((limit, [0, 0]), (np.nextafter(limit, 0), [0, 1])):
        assert merge_redundant(colors, members, eps)[1].tolist() == regions
