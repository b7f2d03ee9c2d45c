"""Merging nodes, relabelling edges, and the similarity matrix, on small cases and against Floyd and Warshall."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import floyd_warshall

import colornet
from colornet.builder import merge_redundant, relabel, similarity
from colornet.colors import MEAN_WHITE, grid_colors, hyab, to_lab

from .test_colors import reference_hyab, reference_lab

NETWORK = colornet.load_default()


def path_lengths(n: int, edges: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths of shortest paths by the algorithm of Floyd and Warshall."""
    graph = np.zeros((n, n))
    graph[tuple(edges.T)] = weights
    return floyd_warshall(graph, directed=False)


def test_similarity_of_the_packaged_network() -> None:
    """Recompute means, their CIELAB, edge weights, paths and similarity from the colours."""
    colors = grid_colors().astype(np.float64)
    member = (NETWORK.region_bits[:, None] >> np.arange(22, dtype=np.uint32) & 1).astype(np.float64)
    means = (member.T @ colors) / member.sum(axis=0)[:, None]
    np.testing.assert_allclose(NETWORK.mean_rgb, means, rtol=1e-13)
    lab = reference_lab(means, MEAN_WHITE)
    weights = np.array([reference_hyab(lab[i], lab[j]) for i, j in NETWORK.edges])
    np.testing.assert_allclose(NETWORK.edge_weights, weights, rtol=1e-11)
    expected = 1 / (1 + path_lengths(22, NETWORK.edges, weights))
    np.testing.assert_allclose(NETWORK.similarity, expected, rtol=1e-11)


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


def test_relabel() -> None:
    edges = np.array([[0, 1], [1, 2], [0, 2], [2, 3]])
    assert relabel(edges, np.array([0, 1, 0, 2])).tolist() == [[0, 1], [0, 2]]
    assert relabel(np.zeros((0, 2), np.int64), np.array([0, 1])).shape == (0, 2)
