"""Construction of the colour network from the colour grid (paper, section "Color network")."""

import numpy as np

from colornet.grid import grid_colors
from colornet.lab import GRID_WHITE, MEAN_WHITE, hyab, to_lab
from colornet.mapper import EPS, map_colors
from colornet.network import ColorNetwork
from colornet.regions import mean_color, merge_redundant, relabel, similarity

__all__ = ["build_network"]


def build_network() -> ColorNetwork:
    """Build the colour network from the colour grid; the result is the same on every call."""
    colors = grid_colors()
    graph = map_colors(to_lab(colors, GRID_WHITE))
    members, region = merge_redundant(colors, graph.members, EPS)

    nerve = relabel(graph.nerve, region)
    cyclic = relabel(graph.cyclic, region)
    edges = np.unique(np.concatenate([nerve, cyclic]), axis=0)
    in_nerve = (edges[:, None] == nerve).all(axis=-1).any(axis=1)

    means = np.array([mean_color(colors, m) for m in members])
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
        n_raw_nodes=len(graph.members),
    )
