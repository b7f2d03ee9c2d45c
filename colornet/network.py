"""The record of the colour network: regions of similar colours, their neighbours, and the regions of each colour.

>>> import colornet, numpy as np
>>> network = colornet.load_default()
>>> network.n_regions
22
>>> weights = network.membership(np.array([[255, 0, 0]], np.uint8))
>>> weights.shape, float(weights.sum())
((1, 22), 1.0)
"""

import dataclasses
import functools
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colornet.colors import GRID_SIZE, grid_index
from colornet.files import atomic_write, read_arrays

__all__ = ["ColorNetwork"]


@dataclasses.dataclass(frozen=True, eq=False)
class ColorNetwork:
    """The colour network, with R regions and E edges. Its arrays are read-only copies.

    Networks with the same contents are equal, so that compiled functions are shared between them. Regions are numbered
    in the order of kmapper's nodes; a merged region has the place of its first node.

    Attributes:
        mean_rgb: [R, 3] float64, arithmetic mean of the sRGB colours of each region, 0..255.
        member_counts: [R] int64, number of grid colours in each region.
        edges: [E, 2] int64, pairs of regions i < j, sorted.
        edge_weights: [E] float64, HyAB distance between the two mean colours.
        cyclic: [E] bool, edges across the cut of the hue circle; the other edges connect regions that share a colour.
        similarity: [R, R] float64, Delta = 1 / (1 + length of the shortest path), diagonal 1.
        region_bits: [140608] uint32, regions of each grid colour (`colornet.grid_index`): bit r is set for region r.
        n_raw_nodes: number of Mapper's nodes before redundant nodes were merged.

    Raises:
        ValueError: an array has another type or shape, or the contents are inconsistent.
    """

    mean_rgb: NDArray[np.float64]
    member_counts: NDArray[np.int64]
    edges: NDArray[np.int64]
    edge_weights: NDArray[np.float64]
    cyclic: NDArray[np.bool_]
    similarity: NDArray[np.float64]
    region_bits: NDArray[np.uint32]
    n_raw_nodes: int

    def __post_init__(self) -> None:
        regions, edges = (np.atleast_1d(array).shape[0] for array in (self.mean_rgb, self.edges))
        expected: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
            "mean_rgb": (np.float64, (regions, 3)),
            "member_counts": (np.int64, (regions,)),
            "edges": (np.int64, (edges, 2)),
            "edge_weights": (np.float64, (edges,)),
            "cyclic": (np.bool_, (edges,)),
            "similarity": (np.float64, (regions, regions)),
            "region_bits": (np.uint32, (GRID_SIZE,)),
        }
        for name, (dtype, shape) in expected.items():
            array = np.array(getattr(self, name))
            if array.dtype != dtype or array.shape != shape:
                raise ValueError(
                    f"{name} is {array.dtype} {list(array.shape)}; expected {np.dtype(dtype)} {list(shape)}"
                )
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not 1 <= self.n_regions <= 32:
            raise ValueError(f"mean_rgb has {self.n_regions} regions; expected 1 to 32")
        if not self.region_bits.all():
            raise ValueError(f"region_bits[{int(np.argmin(self.region_bits))}] is 0; expected a region for each colour")
        if int(self.region_bits.max()) >> self.n_regions:
            raise ValueError(f"region_bits has {int(self.region_bits.max()):#x}; expected {self.n_regions} bits")
        if self.edges.size and not 0 <= self.edges.min() <= self.edges.max() < self.n_regions:
            ends = f"{int(self.edges.min())} to {int(self.edges.max())}"
            raise ValueError(f"edges has regions {ends}; expected 0 to {self.n_regions - 1}")
        for name in ("mean_rgb", "edge_weights", "similarity"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} has a value that is not finite; expected finite numbers")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ColorNetwork) and self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    @property
    def n_regions(self) -> int:
        """Number of colour regions, n_c of the paper (22)."""
        return len(self.mean_rgb)

    def membership(self, rgb: ArrayLike) -> NDArray[np.float32]:
        """Return the region weights of 8-bit colours: 1/m in each of the m regions of the nearest grid colour.

        Args:
            rgb: [..., 3] uint8, sRGB.

        Returns:
            [..., R] float32; rows sum to 1.

        Raises:
            ValueError: `rgb` has another type, or its last axis is not 3.
        """
        bits = self.region_bits[grid_index(rgb)]
        member = (bits[..., None] >> np.arange(self.n_regions, dtype=np.uint32)) & np.uint32(1)
        return np.asarray(member / member.sum(axis=-1, keepdims=True, dtype=np.float32), np.float32)

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the contents in hexadecimal, equal for equal networks.

        Real numbers are rounded to 1e-9, because their last bits may differ between processors.
        """
        digest = hashlib.sha256(f"colornet 1 {self.n_raw_nodes}".encode())
        for field in dataclasses.fields(self)[:-1]:
            array = getattr(self, field.name)
            if array.dtype == np.float64:
                array = np.rint(array * 1e9).astype(np.int64)
            digest.update(f"{field.name} {array.dtype.str} {array.shape}".encode())
            digest.update(np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"))).tobytes())
        return digest.hexdigest()

    def save(self, path: str | Path) -> None:
        """Write the network to a file (npz, compressed) that `load` reads, atomically; equal networks give equal bytes.

        Raises:
            OSError: the file cannot be written.
        """
        arrays: dict[str, Any] = {name: value for name, value in vars(self).items() if name in _FIELDS}
        with atomic_write(path) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(stream, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "ColorNetwork":
        """Load a network that was written by `save`.

        Raises:
            OSError: the file cannot be read.
            ValueError: the file is damaged or is not a colour network; the message names the file.
        """
        arrays = read_arrays(path)
        if arrays.keys() != _FIELDS:
            raise ValueError(f"{path} has {sorted(arrays)}; expected a colour network, {sorted(_FIELDS)}")
        try:
            return cls(**{**arrays, "n_raw_nodes": arrays["n_raw_nodes"].item()})
        except ValueError as error:
            raise ValueError(f"{path} is not a colour network: {error}") from error


_FIELDS = {field.name for field in dataclasses.fields(ColorNetwork)}
