"""Mapper on the colour grid: lens, cover, clusters and nerve (paper, section "Color network").

kmapper covers the lens and joins the clusters; the clusters are DBSCAN's under the HyAB distance. scikit-learn would
evaluate a Python metric pair by pair (hours) or hold a dense matrix (5 GB), so the neighbourhoods are found exactly and
sparsely instead: HyAB is never smaller than the Euclidean distance, hence a k-d tree's Euclidean ball holds every HyAB
neighbour.
"""

import dataclasses
import re
from typing import Any

import kmapper
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from sklearn.cluster import DBSCAN
from sklearn.neighbors import sort_graph_by_row_values

from colornet.lab import hyab

__all__ = ["EPS", "HUE_SHIFT", "MIN_SAMPLES", "HyabDBSCAN", "MapperGraph", "hyab_neighbors", "lens", "map_colors"]

HUE_SHIFT = np.pi / 8
"""xi of the lens: moves the seam of the hue circle away from the reds."""

EPS = 7.0
"""Largest HyAB distance between neighbouring colours."""

MIN_SAMPLES = 6

_N_CUBES = (3, 8)  # chroma, hue
_OVERLAP = (0.10, 0.25)


@dataclasses.dataclass(frozen=True)
class MapperGraph:
    """What Mapper finds, before redundant nodes are joined.

    Attributes:
        names: kmapper's name of each node, in kmapper's order.
        members: for each node, the sorted grid indices of its colours, int64 [n].
        nerve: [e, 2] int64, pairs of nodes i < j that share a colour.
        cyclic: [c, 2] int64, pairs of nodes i < j that the hue circle joins where the lens cuts it.
    """

    names: list[str]
    members: list[NDArray[np.int64]]
    nerve: NDArray[np.int64]
    cyclic: NDArray[np.int64]


def lens(lab: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chroma and shifted hue (not wrapped) of CIELAB colours, [n, 3] to [n, 2] float64."""
    a, b = lab[:, 1], lab[:, 2]
    return np.column_stack([np.hypot(a, b), HUE_SHIFT + np.arctan2(b, a)])


def hyab_neighbors(lab: NDArray[np.float64], radius: float) -> csr_array:
    """All pairs of colours within a HyAB distance.

    Args:
        lab: [n, 3] float64, CIELAB.
        radius: largest distance kept.

    Returns:
        Sparse symmetric [n, n] float64 of distances, without the diagonal.
    """
    # The ball is a hair wider: on its border the tree and `hyab` round differently.
    pairs = KDTree(lab).query_pairs(radius * (1 + 1e-9), output_type="ndarray")
    distances = hyab(lab[pairs[:, 0]], lab[pairs[:, 1]])
    near = distances <= radius
    i, j = pairs[near].astype(np.int32).T
    upper = csr_array((distances[near], (i, j)), shape=(len(lab), len(lab)))
    return csr_array(upper + upper.T)


class HyabDBSCAN:
    """DBSCAN of CIELAB colours under HyAB, with the part of scikit-learn's estimator interface that kmapper uses."""

    def get_params(self) -> dict[str, Any]:
        """The parameters; kmapper leaves out cubes with fewer than `min_samples` colours."""
        return {"eps": EPS, "min_samples": MIN_SAMPLES}

    def fit_predict(self, lab: NDArray[np.float64]) -> NDArray[np.int64]:
        """Cluster of each colour, [n, 3] CIELAB to [n] int64; -1 where it belongs to none."""
        graph = hyab_neighbors(lab, EPS)
        # Colours are distinct, so no stored distance is 0 and an explicit diagonal completes the graph.
        graph.setdiag(0.0)
        graph = sort_graph_by_row_values(graph, warn_when_not_sorted=False)
        clusterer = DBSCAN(eps=EPS, min_samples=MIN_SAMPLES, metric="precomputed")
        return np.asarray(clusterer.fit_predict(graph), np.int64)


def map_colors(lab: NDArray[np.float64]) -> MapperGraph:
    """Run Mapper on CIELAB colours and close the hue circle.

    Args:
        lab: [n, 3] float64, the grid's colours in CIELAB.
    """
    values = lens(lab)
    cover = kmapper.Cover(n_cubes=list(_N_CUBES), perc_overlap=list(_OVERLAP))
    graph = kmapper.KeplerMapper(verbose=0).map(values, lab, clusterer=HyabDBSCAN(), cover=cover)
    names = list(graph["nodes"])
    position = {name: k for k, name in enumerate(names)}
    nerve = [sorted((position[i], position[j])) for i, others in graph["links"].items() for j in others]
    return MapperGraph(
        names=names,
        members=[np.sort(np.asarray(graph["nodes"][name], np.int64)) for name in names],
        nerve=_pairs(nerve),
        cyclic=_pairs(_cyclic_joins(names, cover, values)),
    )


def _cyclic_joins(names: list[str], cover: Any, values: NDArray[np.float64]) -> list[list[int]]:
    """Per chroma interval, all pairs of a node of the first and a node of the last hue interval."""
    # A node's name counts non-empty cubes only; the place of a cube among the cover's centres gives its intervals.
    rows = np.column_stack([np.arange(len(values)), values])
    occupied = [k for k, center in enumerate(cover.centers_) if len(cover.transform_single(rows, center))]
    intervals = [divmod(occupied[_cube_number(name)], _N_CUBES[1]) for name in names]
    return [
        sorted((i, j))
        for i, (chroma_i, hue_i) in enumerate(intervals)
        for j, (chroma_j, hue_j) in enumerate(intervals)
        if chroma_i == chroma_j and hue_i == 0 and hue_j == _N_CUBES[1] - 1
    ]


def _cube_number(name: str) -> int:
    match = re.fullmatch(r"cube(\d+)_cluster\d+", name)
    if match is None:
        raise ValueError(f"kmapper named a node {name!r}; expected cube<number>_cluster<number>")
    return int(match[1])


def _pairs(pairs: list[list[int]]) -> NDArray[np.int64]:
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)
