"""Hypothesis strategies for random colour networks."""

import hypothesis.strategies as st
import numpy as np

from colornet import ColorNetwork
from colornet.grid import GRID_SIZE, grid_colors
from thor2_jax.testing.clouds import seeds

__all__ = ["networks"]


def _network(seed: int, n_regions: int) -> ColorNetwork:
    rng = np.random.default_rng(seed)
    colors = grid_colors().astype(np.float64)
    # Slabs along a random direction; a tenth of each is shared with the next.
    along = colors @ rng.normal(size=3)
    place = np.argsort(np.argsort(along)) / GRID_SIZE * n_regions
    region = place.astype(np.uint32)
    shared = (place - region > 0.9) & (region < n_regions - 1)
    bits = np.uint32(1) << region | np.where(shared, np.uint32(2) << region, np.uint32(0))
    member = (bits[:, None] >> np.arange(n_regions, dtype=np.uint32)) & 1
    counts = member.sum(axis=0).astype(np.int64)
    weights = rng.uniform(5, 50, max(n_regions - 1, 0))
    at = np.concatenate([[0], np.cumsum(weights)])
    return ColorNetwork(
        mean_rgb=member.T @ colors / counts[:, None],
        member_counts=counts,
        edges=np.stack([np.arange(n_regions - 1), np.arange(1, n_regions)], axis=1).astype(np.int64),
        edge_weights=weights,
        cyclic=np.zeros(n_regions - 1, bool),
        similarity=1 / (1 + np.abs(at[:, None] - at)),
        region_bits=bits.astype(np.uint32),
        n_raw_nodes=n_regions,
    )


def networks(n_regions: int = 5) -> st.SearchStrategy[ColorNetwork]:
    """Generate networks whose regions are overlapping slabs of the colour cube, connected in a chain.

    All networks with R regions have 2 R - 1 region sets, so that they share compiled functions.

    Args:
        n_regions: R, 1 to 32.
    """
    return st.builds(_network, seeds(), st.just(n_regions))
