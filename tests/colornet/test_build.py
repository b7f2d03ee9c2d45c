"""The packaged network: the result of a build from scratch, with the counts of the paper."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import colornet
from colornet.builder import HyabDBSCAN
from colornet.colors import GRID_WHITE, grid_colors, to_lab

NETWORK = colornet.load_default()
BUILD = """
import re, sys
from pathlib import Path
import colornet
colornet.build().save(sys.argv[1])
# The peak of getrusage is at least that of the parent process.
print(re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
def test_packaged_network_is_built_in_little_memory(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", "-c", BUILD, str(tmp_path / "network.npz")]
    peak = subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout
    assert int(peak) < 3 * 2**20
    rebuilt = colornet.load(tmp_path / "network.npz")
    for field in dataclasses.fields(NETWORK):
        built, packaged = getattr(rebuilt, field.name), getattr(NETWORK, field.name)
        if np.asarray(packaged).dtype == np.float64:  # another processor may round a cube root differently
            np.testing.assert_allclose(built, packaged, rtol=1e-12, err_msg=field.name)
        else:
            np.testing.assert_array_equal(built, packaged, err_msg=field.name)
    assert rebuilt.fingerprint == NETWORK.fingerprint


def test_regions_are_the_clusters_of_their_cubes() -> None:
    """Clusters of five cubes of the cover, found anew, are regions; one was merged with that of another cube.

    The cover has 3 x 8 intervals of chroma and hue, each widened by its overlap.
    """
    lab = to_lab(grid_colors(), GRID_WHITE)
    lens = np.hypot(lab[:, 1], lab[:, 2]), np.arctan2(lab[:, 2], lab[:, 1])
    regions = [np.flatnonzero(NETWORK.region_bits >> np.uint32(r) & 1) for r in range(NETWORK.n_regions)]
    equal_regions = []
    for cube in ((1, 0), (1, 1), (2, 3), (2, 5), (2, 7)):
        inside = np.ones(len(lab), bool)
        for values, count, overlap, number in zip(lens, (3, 8), (0.10, 0.25), cube, strict=True):
            length = np.ptp(values) / count
            inside &= np.abs(values - values.min() - length * (number + 0.5)) <= length / (2 * (1 - overlap))
        rows = np.flatnonzero(inside)
        labels = HyabDBSCAN().fit_predict(lab[rows])
        for cluster in (rows[labels == k] for k in range(labels.max() + 1)):
            equal_regions.append([r for r, members in enumerate(regions) if np.array_equal(cluster, members)])
    assert equal_regions == [[8], [9], [17], [], [19], [21]]


def test_counts_and_edges() -> None:
    """Regions that share colours are joined, and two pairs at the cut of the hue circle."""
    assert (NETWORK.n_raw_nodes, NETWORK.n_regions, len(NETWORK.edges)) == (23, 22, 55)
    assert NETWORK.edges[NETWORK.cyclic].tolist() == [[0, 7], [8, 15]]
    members = NETWORK.region_bits[:, None] >> np.arange(22, dtype=np.uint32) & 1
    sharing = np.argwhere(np.triu(members.T.astype(float) @ members, 1))
    np.testing.assert_array_equal(NETWORK.edges[~NETWORK.cyclic], sharing)
