"""A PointNet (Qi et al., CVPR 2017) on the points and colours of view-normalized clouds."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.model.classifier import model_arrays, model_from_arrays
from training.baselines.baseline import BaselineInputs

__all__ = ["POINTS", "ColoredPointNet", "PointNet", "point_features", "random_indices"]

POINTS = 384
"""Points sampled from each cloud."""

SHARED = (64, 128, 384)
HEAD = 256
INFERENCE_BATCH = 256
SAMPLING_SEED = 0


class PointNet(nnx.Module):
    """Layers 6-64-128-384 on each point, maximum over the points, a layer of 256, logits; ReLU in between."""

    def __init__(self, n_classes: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        sizes = (6, *SHARED)
        self.shared = nnx.List([nnx.Linear(a, b, rngs=rngs) for a, b in zip(sizes[:-1], sizes[1:], strict=True)])
        self.hidden = nnx.Linear(SHARED[-1], HEAD, rngs=rngs)
        self.head = nnx.Linear(HEAD, n_classes, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return logits [B, C] for `point_features` [B, P, 6]."""
        for layer in self.shared:
            x = nnx.relu(layer(x))
        return self.head(nnx.relu(self.hidden(x.max(axis=1))))


def point_features(xyz: Any, rgb: Any, box: Any) -> jax.Array:
    """Return [B, P, 6] inputs: points relative to the centre of their box, scaled units, and colours minus 0.5.

    Args:
        xyz: [B, P, 3] points.
        rgb: [B, P, 3] colours from 0 to 255.
        box: [B, 3] side lengths of the bounding boxes.
    """
    return jnp.concatenate([xyz - box[:, None] / 2, rgb.astype(jnp.float32) / 255 - 0.5], axis=2)


def random_indices(count: int, points: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return the indices of `points` random points of `count`, repeated if there are too few points."""
    return np.resize(rng.permutation(count), points)


@partial(jax.jit, static_argnums=0)
def _probabilities(graph: Any, params: Any, xyz: Any, rgb: Any, box: Any) -> jax.Array:
    return jax.nn.softmax(nnx.merge(graph, params)(point_features(xyz, rgb, box)))


class ColoredPointNet:
    """A trained PointNet with its point sampling."""

    def __init__(self, model: PointNet) -> None:
        """Store the network."""
        self._model = model
        self._graph, self._params = nnx.split(model)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the weights by their paths."""
        return model_arrays(self._model)

    @classmethod
    def with_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_classes: int) -> "ColoredPointNet":
        """Build the network from `arrays`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        return cls(model_from_arrays(lambda: PointNet(n_classes, rngs=nnx.Rngs(0)), arrays))

    def probabilities(self, inputs: BaselineInputs) -> NDArray[np.float32]:
        """Return class probabilities [B, C]; which points are sampled depends only on the number of points."""
        points, colors = np.asarray(inputs.normal.points), np.asarray(inputs.normal.colors)
        counts = np.asarray(inputs.normal.mask).sum(axis=1)
        xyz = np.zeros((len(points), POINTS, 3), np.float32)
        rgb, box = np.zeros_like(xyz), np.zeros((len(points), 3), np.float32)
        for row, count in enumerate(counts.tolist()):
            if count:  # padding follows the points
                sample = random_indices(count, POINTS, np.random.default_rng(SAMPLING_SEED))
                xyz[row], rgb[row] = points[row, sample], colors[row, sample] * 255
                box[row] = points[row, :count].max(axis=0)
        return np.asarray(_probabilities(self._graph, self._params, xyz, rgb, box))

    def predict(self, xyz: NDArray[Any], rgb: NDArray[Any], box: NDArray[Any]) -> NDArray[np.float32]:
        """Return class probabilities [V, C] for sampled points [V, POINTS, 3], their colours and boxes [V, 3]."""
        chunks = []
        for first in range(0, len(xyz), INFERENCE_BATCH):
            rows = np.resize(np.arange(first, min(first + INFERENCE_BATCH, len(xyz))), INFERENCE_BATCH)
            values = _probabilities(self._graph, self._params, xyz[rows].astype(np.float32), rgb[rows], box[rows])
            chunks.append(np.asarray(values)[: len(xyz) - first])
        return np.concatenate(chunks)
