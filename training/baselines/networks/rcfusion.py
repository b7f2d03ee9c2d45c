"""RCFusion (Loghmani et al., "Recurrent Convolutional Fusion for RGB-D Object Recognition", RA-L 2019).

Two ResNet-18 streams. The features of each stage are projected to vectors of one length, and a gated recurrent unit
reads the vectors of both streams stage by stage, from the first to the last.
"""

import jax
import jax.numpy as jnp
from flax import nnx

from training.baselines.networks.resnet import ResNet18, batch_norm, convolution

__all__ = ["GRU", "RCFusion"]


class Projection(nnx.Module):
    """Convolution of 1 x 1 pixel, normalization, ReLU and maximum over all pixels."""

    def __init__(self, inputs: int, outputs: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.conv = convolution(inputs, outputs, 1, 1, rngs)
        self.bn = batch_norm(outputs, rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return vectors [B, outputs] for features [B, H, W, inputs]."""
        return nnx.relu(self.bn(self.conv(x))).max(axis=(1, 2))


class GRU(nnx.Module):
    """A gated recurrent unit with the gates and biases of PyTorch's."""

    def __init__(self, inputs: int, memory: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `memory` is the length of the state."""
        self.memory = memory
        self.input = nnx.Linear(inputs, 3 * memory, rngs=rngs)
        self.hidden = nnx.Linear(memory, 3 * memory, rngs=rngs)

    def __call__(self, sequence: jax.Array) -> jax.Array:
        """Return the last state [B, memory] for a sequence [B, T, inputs] and the first state 0."""
        state = jnp.zeros((len(sequence), self.memory), sequence.dtype)
        for step in range(sequence.shape[1]):
            reset_x, update_x, new_x = jnp.split(self.input(sequence[:, step]), 3, axis=-1)
            reset_h, update_h, new_h = jnp.split(self.hidden(state), 3, axis=-1)
            update = nnx.sigmoid(update_x + update_h)
            new = jnp.tanh(new_x + nnx.sigmoid(reset_x + reset_h) * new_h)
            state = (1 - update) * new + update * state
        return state


class RCFusion(nnx.Module):
    """Two ResNet-18 and a recurrent fusion of their stages."""

    def __init__(self, n_classes: int, width: int, projection: int, memory: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights.

        Args:
            n_classes: number of classes.
            width: channels of the first stage of the streams.
            projection: length of the projected features.
            memory: length of the recurrent state.
            rngs: random number generators.
        """
        self.color, self.normals = ResNet18(width, rngs=rngs), ResNet18(width, rngs=rngs)
        self.color_projections, self.normal_projections = (
            nnx.List([Projection(channels, projection, rngs=rngs) for channels in stream.channels])
            for stream in (self.color, self.normals)
        )
        self.gru = GRU(2 * projection, memory, rngs=rngs)
        self.head = nnx.Linear(memory, n_classes, rngs=rngs)

    def __call__(self, color: jax.Array, normals: jax.Array) -> jax.Array:
        """Return logits [B, C] for network inputs [B, S, S, 3] of colour and normals."""
        streams = ((self.color(color), self.color_projections), (self.normals(normals), self.normal_projections))
        projected = [
            jnp.stack([project(features) for features, project in zip(stages, projections, strict=True)], axis=1)
            for stages, projections in streams
        ]
        return self.head(self.gru(jnp.concatenate(projected, axis=-1)))
