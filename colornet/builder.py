"""Construction of the colour network: Mapper, regions, edges and similarity (paper, section "Color network").

Mapper consists of a lens, a cover, clusters and their nerve. kmapper covers the lens, DBSCAN finds the clusters with
the HyAB distance, and the nerve connects clusters that share a colour. scikit-learn would evaluate a Python metric pair
by pair (hours) or store a dense matrix (5 GB). Neighbourhoods are therefore computed exactly and sparsely: HyAB is
never smaller than the Euclidean distance, so that the Euclidean ball of a k-d tree contains every HyAB neighbour.
"""

import itertools

import kmapper
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN
from sklearn.neighbors import sort_graph_by_row_values

from colornet.colors import GRID_WHITE, MEAN_WHITE, grid_colors, hyab, to_lab
from colornet.network import ColorNetwork

__all__ = ["build_network", "similarity"]

HUE_SHIFT = np.pi / 8
"""Shift xi of the lens, which moves the cut of the hue circle away from the reds."""

EPS = 7.0
"""Largest HyAB distance between neighbouring colours."""

MIN_SAMPLES = 6
"""Smallest number of colours in the neighbourhood of a core point of DBSCAN."""

_N_CUBES = (3, 8)  # chroma, hue
_OVERLAP = (0.10, 0.25)

_MIN_SHARED = 0.95
"""Fraction of the smaller node's colours above which two nodes can be redundant."""


def lens(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return chroma and shifted hue (not wrapped) of CIELAB colours: [n, 3] to [n, 2] float64."""
    a, b = lab[:, 1], lab[:, 2]
    return np.column_stack([np.hypot(a, b), HUE_SHIFT + np.arctan2(b, a)])


def hyab_neighbors(lab: NDArray[np.float64], radius: float) -> csr_array:
    """Find all pairs of colours within a HyAB distance.

    Args:
        lab: [n, 3] float64, CIELAB.
        radius: largest distance kept.

    Returns:
        Distances, a sparse symmetric [n, n] float64 matrix without the diagonal.
    """
    # The ball is slightly larger, because the tree and `hyab` round differently on its border.
    pairs = KDTree(lab).query_pairs(radius * (1 + 1e-9), output_type="ndarray")
    distances = hyab(lab[pairs[:, 0]], lab[pairs[:, 1]])
    near = distances <= radius
    i, j = pairs[near].astype(np.int32).T
    upper = csr_array((distances[near], (i, j)), shape=(len(lab), len(lab)))
    return csr_array(upper + upper.T)


def hyab_clusters(lab: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the DBSCAN cluster of each colour by the HyAB distance, [n, 3] CIELAB to [n] int64; -1 for noise."""
    graph = hyab_neighbors(lab, EPS)
    # Colours are distinct, so no other stored distance is 0; an explicit diagonal completes the graph.
    graph.setdiag(0.0)
    graph = sort_graph_by_row_values(graph, warn_when_not_sorted=False)
    clusterer = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed")
    return np.asarray(clusterer.fit_predict(graph), np.int64)


def _map_colors(lab: NDArray[np.float64]) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    """Return the nodes of Mapper on CIELAB colours, and those to connect across the cut of the hue circle.

    Args:
        lab: [n, 3] float64, the colours of the grid in CIELAB.

    Returns:
        For each node, in the order of the cubes and of their clusters, the sorted grid indices of its colours, int64
        [n]; and the pairs of nodes [c, 2] int64 in the first and in the last hue interval of one chroma interval.
    """
    rows = np.column_stack([np.arange(len(lab)), lens(lab)])  # kmapper expects an index in the first column
    cover = kmapper.Cover(n_cubes=list(_N_CUBES), perc_overlap=list(_OVERLAP))
    members: list[NDArray[np.int64]] = []
    intervals: list[tuple[int, int]] = []  # chroma and hue interval of each node
    for cube, center in enumerate(cover.fit(rows)):
        inside = cover.transform_single(rows, center)[:, 0].astype(np.int64)
        if len(inside) >= MIN_SAMPLES:
            cluster_of = hyab_clusters(lab[inside])
            clusters = [inside[cluster_of == k] for k in range(cluster_of.max() + 1)]
            members += clusters
            intervals += [divmod(cube, _N_CUBES[1])] * len(clusters)
    pairs = itertools.combinations(range(len(members)), 2)
    across = [(i, j) for i, j in pairs if intervals[i][1] == 0 and intervals[j] == (intervals[i][0], _N_CUBES[1] - 1)]
    return members, np.array(across, np.int64)


def build_network() -> ColorNetwork:
    """Build the colour network from the colour grid; the result is the same on every call."""
    colors = grid_colors()
    nodes, across = _map_colors(to_lab(colors, GRID_WHITE))
    members, region = merge_redundant(colors, nodes, EPS)

    pairs = itertools.combinations(range(len(members)), 2)
    nerve = np.array([(i, j) for i, j in pairs if np.intersect1d(members[i], members[j]).size])
    edges = np.unique(np.concatenate([nerve, np.sort(region[across], axis=1)]), axis=0)
    in_nerve = (edges[:, None] == nerve).all(axis=-1).any(axis=1)

    means = np.array([colors[rows].mean(axis=0) for rows in members])
    lab = to_lab(means, MEAN_WHITE)
    weights = hyab(lab[edges[:, 0]], lab[edges[:, 1]])

    bits = np.zeros(len(colors), np.uint32)
    for r, rows in enumerate(members):
        bits[rows] |= np.uint32(1 << r)
    return ColorNetwork(
        mean_rgb=means,
        member_counts=np.array([len(m) for m in members], np.int64),
        edges=edges,
        edge_weights=weights,
        cyclic=~in_nerve,
        similarity=similarity(len(members), edges, weights),
        region_bits=bits,
        n_raw_nodes=len(nodes),
    )


def merge_redundant(
    colors: NDArray[np.uint8], members: list[NDArray[np.int64]], eps: float
) -> tuple[list[NDArray[np.int64]], NDArray[np.int64]]:
    """Merge redundant nodes.

    Two nodes are redundant if they share more than 95 % of the smaller node's members and the HyAB distance of their
    mean colours is at most `eps`.

    Args:
        colors: [n, 3] uint8, sRGB.
        members: sorted rows of `colors` in each node, int64 [m].
        eps: largest HyAB distance of mean colours.

    Returns:
        The members of each region, in the order of the regions' first nodes; and the region of each node, [nodes]
        int64.
    """
    has = np.zeros((len(members), len(colors)))
    for row, indices in zip(has, members, strict=True):
        row[indices] = 1
    shared, sizes = has @ has.T, has.sum(axis=1)
    means = to_lab(np.array([colors[rows].mean(axis=0) for rows in members]), MEAN_WHITE)
    overlap = shared > _MIN_SHARED * np.minimum.outer(sizes, sizes)
    n_regions, component = connected_components(overlap & (hyab(means[:, None], means) <= eps), directed=False)
    _, first = np.unique(component, return_index=True)
    region = np.argsort(np.argsort(first))[component].astype(np.int64)
    return [np.flatnonzero(has[region == k].any(axis=0)) for k in range(n_regions)], region


def similarity(n_regions: int, edges: NDArray[np.integer], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the similarity Delta, 1 / (1 + length of the shortest path); 0 between regions without a path.

    Args:
        n_regions: number of regions n.
        edges: [e, 2] integers, pairs of regions, each once.
        weights: [e] float64, positive.

    Returns:
        [n, n] float64, symmetric, diagonal 1.
    """
    graph = csr_array((weights, (edges[:, 0], edges[:, 1])), shape=(n_regions, n_regions))
    lengths = dijkstra(graph, directed=False)
    # Lengths are summed along the path, so the minimum of both directions makes the matrix exactly symmetric.
    lengths = np.minimum(lengths, lengths.T)
    return np.asarray(1.0 / (1.0 + lengths))
