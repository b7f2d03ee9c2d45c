"""One build of the colour network from scratch, in a separate process so that its memory can be measured."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import colornet
from colornet.mapper import MapperGraph

_BUILD = """
import re, sys
from pathlib import Path
import numpy as np
import colornet, colornet.builder as builder

def recorded(lab, map_colors=builder.map_colors):
    global graph
    graph = map_colors(lab)
    return graph

builder.map_colors = recorded
network = colornet.build()
network.save(sys.argv[1])
members = {f"members_{k}": m for k, m in enumerate(graph.members)}
np.savez(sys.argv[2], names=graph.names, nerve=graph.nerve, cyclic=graph.cyclic, **members)
# The peak of getrusage is at least that of the parent process.
peak = re.search(r"VmHWM:\\s*(\\d+) kB", Path("/proc/self/status").read_text())
print(peak[1])
"""


@dataclasses.dataclass(frozen=True)
class Rebuilt:
    """The network built from scratch, the graph of Mapper, and the memory it took."""

    network: colornet.ColorNetwork
    graph: MapperGraph
    mebibytes: float


@pytest.fixture(scope="session")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Rebuilt:
    """Run `colornet.build()` once per session."""
    folder = tmp_path_factory.mktemp("build")
    root = Path(colornet.__file__).resolve().parents[1]
    command = [sys.executable, "-W", "error", "-c", _BUILD, str(folder / "network.npz"), str(folder / "graph.npz")]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with np.load(folder / "graph.npz") as file:
        members = [file[f"members_{k}"] for k in range(len(file["names"]))]
        graph = MapperGraph(file["names"].tolist(), members, file["nerve"], file["cyclic"])
    return Rebuilt(colornet.load(folder / "network.npz"), graph, int(done.stdout) / 1024)


@pytest.fixture(scope="session")
def network() -> colornet.ColorNetwork:
    """The packaged network."""
    return colornet.load_default()
