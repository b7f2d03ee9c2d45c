"""Mapper on the colour grid: lens, cover, clusters and nerve (paper, section "Color network").

kmapper covers the lens and connects the clusters, which DBSCAN finds with the HyAB distance. scikit-learn would
evaluate a Python metric pair by pair (hours) or store a dense matrix (5 GB). Neighbourhoods are therefore computed
exactly and sparsely: HyAB is never smaller than the Euclidean distance, so that the Euclidean ball of a k-d tree
contains every HyAB neighbour.
"""

from typing import Any

import kmapper
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN
from sklearn.neighbors import sort_graph_by_row_values

from colornet.lab import hyab

__all__ = ["EPS", "HUE_SHIFT", "MIN_SAMPLES", "HyabDBSCAN", "hyab_neighbors", "lens", "map_colors"]

HUE_SHIFT = np.pi / 8
"""Shift xi of the lens, which moves the cut of the hue circle away from the reds."""

EPS = 7.0
"""Largest HyAB distance between neighbouring colours."""

MIN_SAMPLES = 6
"""Smallest number of colours in the neighbourhood of a core point of DBSCAN."""

_N_CUBES = (3, 8)  # chroma, hue
_OVERLAP = (0.10, 0.25)


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
    """DBSCAN of CIELAB colours with the HyAB distance; has those methods of an estimator that kmapper calls."""

    def get_params(self) -> dict[str, Any]:
        """Return the parameters; kmapper skips cubes with fewer than `min_samples` colours."""
        return {"eps": EPS, "min_samples": MIN_SAMPLES}

    def fit_predict(self, lab: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the cluster of each colour, [n, 3] CIELAB to [n] int64; -1 for noise."""
        graph = hyab_neighbors(lab, EPS)
        # Colours are distinct: no other stored distance is 0, and an explicit diagonal completes the graph.
        graph.setdiag(0.0)
        graph = sort_graph_by_row_values(graph, warn_when_not_sorted=False)
        clusterer = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed")
        return np.asarray(clusterer.fit_predict(graph), np.int64)


def map_colors(lab: NDArray[np.float64]) -> tuple[list[NDArray[np.int64]], NDArray[np.int64], NDArray[np.int64]]:
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
    """Return all pairs of a node in the first and one in the last hue interval of the same chroma interval."""
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
