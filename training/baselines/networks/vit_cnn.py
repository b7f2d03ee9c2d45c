"""ViT-CNN (Xiong et al., 2022; arXiv 2210.04613): features of a ViT and of a DenseNet, classified by an MLP."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from training.baselines.networks.densenet import DenseNet
from training.baselines.networks.vit import ViT, ViTConfig

__all__ = ["ViTCNN"]

HIDDEN = 512


class ViTCNN(nnx.Module):
    """A ViT on colour, a DenseNet on normals, and an MLP on the features of both."""

    def __init__(self, n_classes: int, vit: ViTConfig, cnn: dict[str, Any], size: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights.

        Args:
            n_classes: number of classes.
            vit: architecture of the ViT.
            cnn: arguments of the DenseNet.
            size: side of the images, pixels.
            rngs: random number generators.
        """
        self.vit = ViT(vit, size, rngs=rngs)
        self.cnn = DenseNet(**cnn, rngs=rngs)
        self.hidden = nnx.Linear(self.vit.channels + self.cnn.channels, HIDDEN, rngs=rngs)
        self.head = nnx.Linear(HIDDEN, n_classes, rngs=rngs)

    def __call__(self, color: jax.Array, normals: jax.Array) -> jax.Array:
        """Return logits [B, C] for network inputs [B, S, S, 3] of colour and normals."""
        features = jnp.concatenate([self.vit(color), self.cnn(normals)], axis=-1)
        return self.head(nnx.relu(self.hidden(features)))
