"""Construction of the colour network: Mapper, regions, edges and similarity (paper, section "Color network").

Mapper consists of a lens, a cover, clusters and their nerve. kmapper covers the lens and connects the clusters, which
DBSCAN finds with the HyAB distance. scikit-learn would evaluate a Python metric pair by pair (hours) or store a dense
matrix (5 GB). Neighbourhoods are therefore computed exactly and sparsely: HyAB is never smaller than the Euclidean
distance, so that the Euclidean ball of a k-d tree contains every HyAB neighbour.
"""

from typing import Any

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


class HyabDBSCAN:
    """DBSCAN of CIELAB colours with the HyAB distance; it has the methods of an estimator that kmapper calls."""

    def get_params(self) -> dict[str, Any]:
        """Return the parameters; kmapper skips cubes with fewer than `min_samples` colours."""
        return {"eps": EPS, "min_samples": MIN_SAMPLES}

    def fit_predict(self, lab: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the cluster of each colour, [n, 3] CIELAB to [n] int64; -1 for noise."""
        graph = hyab_neighbors(lab, EPS)
        # Colours are distinct, so no other stored distance is 0; an explicit diagonal completes the graph.
        graph.setdiag(0.0)
        graph = sort_graph_by_row_values(graph, warn_when_not_sorted=False)
        clusterer = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed")
        return np.asarray(clusterer.fit_predict(graph), np.int64)


def _map_colors(lab: NDArray[np.float64]) -> tuple[list[NDArray[np.int64]], NDArray[np.int64], NDArray[np.int64]]:
    """Run Mapper on CIELAB colours, and connect the nodes across the cut of the hue circle.

    Args:
        lab: [n, 3] float64, the colours of the grid in CIELAB.

    Returns:
        For each node, in kmapper's order, the sorted grid indices of its colours, int64 [n]; the nerve [e, 2] int64,
        pairs of nodes that share a colour; and pairs of nodes [c, 2] int64 that are neighbours across the cut.
    """
    values = lens(lab)
    cover = kmapper.Cover(n_cubes=list(_N_CUBES), perc_overlap=list(_OVERLAP))
    graph = kmapper.KeplerMapper(verbose=0).map(values, lab, clusterer=HyabDBSCAN(), cover=cover)
    names = list(graph["nodes"])
    members = [np.sort(np.asarray(graph["nodes"][name], np.int64)) for name in names]
    nerve = [(names.index(i), names.index(j)) for i, others in graph["links"].items() for j in others]
    return members, np.array(nerve, np.int64), np.array(_cyclic_pairs(names, cover, values), np.int64)


def _cyclic_pairs(names: list[str], cover: Any, values: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return all pairs of nodes in the first and in the last hue interval of the same chroma interval."""
    # Names of nodes (cube3_cluster0) number non-empty cubes only; the position of a cube among all centres gives its
    # intervals.
    rows = np.column_stack([np.arange(len(values)), values])
    occupied = [k for k, center in enumerate(cover.centers_) if len(cover.transform_single(rows, center))]
    cubes = [int(name.removeprefix("cube").split("_")[0]) for name in names]
    intervals = [divmod(occupied[cube], _N_CUBES[1]) for cube in cubes]
    return [
        (i, j)
        for i, (chroma_i, hue_i) in enumerate(intervals)
        for j, (chroma_j, hue_j) in enumerate(intervals)
        if chroma_i == chroma_j and hue_i == 0 and hue_j == _N_CUBES[1] - 1
    ]


def build_network() -> ColorNetwork:
    """Build the colour network from the colour grid; the result is the same on every call."""
    colors = grid_colors()
    nodes, *pairs = _map_colors(to_lab(colors, GRID_WHITE))
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
    # Lengths are summed along the path, so the minimum of both directions makes the matrix exactly symmetric.
    lengths = np.minimum(lengths, lengths.T)
    return np.asarray(1.0 / (1.0 + lengths))
