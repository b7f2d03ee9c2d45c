"""The colour network of THOR2: 22 regions of similar colours and the similarity of every two regions.

>>> import colornet
>>> network = colornet.load_default()
>>> network.n_regions, len(network.edges)
(22, 55)
>>> network.similarity.shape
(22, 22)

`build` builds the same network from scratch (about ten seconds); `colornet.draw` draws it.
"""

import functools
from pathlib import Path

from colornet.colors import grid_index
from colornet.network import ColorNetwork

__all__ = ["ColorNetwork", "build", "grid_index", "load", "load_default", "save"]


def build() -> ColorNetwork:
    """Build the colour network from scratch, with kmapper; the packaged network is the result of this function."""
    # kmapper, scikit-learn and colour-science take seconds to import and are not needed to load a network.
    from colornet.builder import build_network

    return build_network()


@functools.cache
def load_default() -> ColorNetwork:
    """Return the packaged colour network."""
    return load(Path(__file__).with_name("data") / "network.npz")


def load(path: str | Path) -> ColorNetwork:
    """Load a colour network that was written by `save`.

    Raises:
        OSError: the file cannot be read, or the path has a null character.
        ValueError: the file is damaged or is not a colour network; the message names the file.
    """
    return ColorNetwork.load(path)


def save(network: ColorNetwork, path: str | Path) -> None:
    """Write a colour network to a file (npz), atomically.

    Raises:
        OSError: the file cannot be written, or the path has a null character.
    """
    network.save(path)
