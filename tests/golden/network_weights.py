"""Random weights and images for the golden outputs of the image networks; needs NumPy only."""

import zlib

import numpy as np

POINTS = 16
"""Values of an output that are stored."""


def random_tensor(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """Return a float32 tensor of a PyTorch model; it depends on its name and shape only."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    if name.endswith("running_var") or (name.endswith(("weight", "gamma")) and len(shape) == 1):
        return rng.uniform(0.5, 1.5, shape).astype(np.float32)
    if len(shape) == 1:
        return (0.1 * rng.standard_normal(shape, np.float32)).astype(np.float32)
    deviation = 0.2 if len(shape) == 3 else (2 / np.prod(shape[1:])) ** 0.5
    return np.float32(deviation) * rng.standard_normal(shape, np.float32)


def random_images(name: str, count: int, size: int) -> np.ndarray:
    """Return float32 network inputs [count, size, size, 3]."""
    return np.random.default_rng(zlib.crc32(name.encode())).standard_normal((count, size, size, 3), np.float32)


def sampled(values: np.ndarray) -> np.ndarray:
    """Return `POINTS` evenly spread values of an output, and its mean and root mean square: [POINTS + 2] float64."""
    flat = np.asarray(values, np.float64).ravel()
    picked = flat[np.linspace(0, len(flat) - 1, POINTS).round().astype(int)]
    return np.concatenate([picked, [flat.mean(), np.sqrt((flat**2).mean())]])
