"""Construction of the colour network: regions, edges and similarity (paper, section "Color network")."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from colornet.grid import grid_colors
from colornet.lab import GRID_WHITE, MEAN_WHITE, hyab, to_lab
from colornet.mapper import EPS, map_colors
from colornet.network import ColorNetwork

__all__ = ["build_network", "merge_redundant", "relabel", "similarity"]

_MIN_SHARED = 0.95
"""Share of the smaller node's colours above which two nodes can be redundant."""


def build_network() -> ColorNetwork:
    """Build the colour network from the colour grid; the result is the same on every call."""
    colors = grid_colors()
    nodes, *pairs = map_colors(to_lab(colors, GRID_WHITE))
    members, region = merge_redundant(colors, nodes, EPS)

    nerve, cyclic = (relabel(edges, region) for edges in pairs)
    edges = np.unique(np.concatenate([nerve, cyclic]), axis=0)
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

    Two nodes are redundant if they share more than 95 % of the members of the smaller one and the HyAB distance of
    their mean colours is at most `eps`.

    Args:
        colors: [n, 3] uint8, sRGB.
        members: for each node the sorted rows of `colors` in it, int64 [m].
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


def relabel(edges: NDArray[np.int64], region: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert edges between nodes to edges between regions: distinct sorted pairs i < j.

    Args:
        edges: [e, 2] int64, pairs of nodes.
        region: [nodes] int64, the region of each node.
    """
    moved = np.sort(region[edges], axis=1)
    return np.unique(moved[moved[:, 0] != moved[:, 1]], axis=0)


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
    # Lengths are summed along the path: the minimum of both directions makes the matrix exactly symmetric.
    lengths = np.minimum(lengths, lengths.T)
    return np.asarray(1.0 / (1.0 + lengths))
