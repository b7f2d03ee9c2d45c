"""The packaged network: the result of a build from scratch, with the counts of the paper."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from processes import finish_programs, start_program

import colornet

NETWORK = colornet.load_default()
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


def test_counts_and_edges() -> None:
    """Regions that share colours are joined, and two pairs at the cut of the hue circle."""
    assert (NETWORK.n_raw_nodes, NETWORK.n_regions, len(NETWORK.edges)) == (23, 22, 55)
    assert NETWORK.edges[NETWORK.cyclic].tolist() == [[0, 7], [8, 15]]
    members = NETWORK.region_bits[:, None] >> np.arange(22, dtype=np.uint32) & 1
    sharing = np.argwhere(np.triu(members.T.astype(float) @ members, 1))
    np.testing.assert_array_equal(NETWORK.edges[~NETWORK.cyclic], sharing)
