"""DenseNet (Huang et al., CVPR 2017), with the module names of torchvision and timm."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

from training.baselines.networks.resnet import batch_norm, convolution, stem_pool
from training.baselines.networks.vit import ViT, ViTConfig

__all__ = ["DENSENET_161", "DenseNet", "ViTCNN"]

BOTTLENECK = 4
"""Channels between the convolutions of a layer, relative to its output."""

DENSENET_161 = {"growth": 48, "blocks": (6, 12, 36, 24)}
"""Arguments of `DenseNet`."""


class DenseLayer(nnx.Module):
    """A bottleneck layer, whose output is appended to its input."""

    def __init__(self, inputs: int, growth: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.norm1 = batch_norm(inputs, rngs)
        self.conv1 = convolution(inputs, BOTTLENECK * growth, 1, 1, rngs)
        self.norm2 = batch_norm(BOTTLENECK * growth, rngs)
        self.conv2 = convolution(BOTTLENECK * growth, growth, 3, 1, rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, H, W, inputs + growth] features for [B, H, W, inputs]."""
        y = self.conv1(nnx.relu(self.norm1(x)))
        return jnp.concatenate([x, self.conv2(nnx.relu(self.norm2(y)))], axis=-1)


class DenseBlock(nnx.Module):
    """Layers denselayer1, denselayer2, ... in a row."""

    def __init__(self, inputs: int, growth: int, layers: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.n_layers = layers
        for number in range(layers):
            setattr(self, f"denselayer{number + 1}", DenseLayer(inputs + number * growth, growth, rngs=rngs))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return the input and the outputs of all layers, along the channels."""
        for number in range(self.n_layers):
            x = getattr(self, f"denselayer{number + 1}")(x)
        return x


class Transition(nnx.Module):
    """Halve the channels, the height and the width."""

    def __init__(self, inputs: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.norm = batch_norm(inputs, rngs)
        self.conv = convolution(inputs, inputs // 2, 1, 1, rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, H/2, W/2, inputs/2] features for [B, H, W, inputs]."""
        return nnx.avg_pool(self.conv(nnx.relu(self.norm(x))), (2, 2), (2, 2))


class DenseNet(nnx.Module):
    """A DenseNet without its classifier.

    Attributes:
        channels: length of the features.
    """

    PREFIX = "features."
    """Prefix of the names of tensors in the public files."""

    def __init__(self, growth: int, blocks: tuple[int, ...], *, rngs: nnx.Rngs) -> None:
        """Initialize the weights.

        Args:
            growth: channels that a layer adds; the first convolution has twice as many.
            blocks: number of layers of each block.
            rngs: random number generators.
        """
        width = 2 * growth
        self.n_blocks = len(blocks)
        self.conv0 = convolution(3, width, 7, 2, rngs)
        self.norm0 = batch_norm(width, rngs)
        for number, layers in enumerate(blocks, 1):
            setattr(self, f"denseblock{number}", DenseBlock(width, growth, layers, rngs=rngs))
            width += layers * growth
            if number < len(blocks):
                setattr(self, f"transition{number}", Transition(width, rngs=rngs))
                width //= 2
        self.norm5 = batch_norm(width, rngs)
        self.channels = width

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, channels] features for images [B, S, S, 3]: the means over all pixels."""
        x = stem_pool(nnx.relu(self.norm0(self.conv0(x))))
        for number in range(1, self.n_blocks + 1):
            x = getattr(self, f"denseblock{number}")(x)
            if number < self.n_blocks:
                x = getattr(self, f"transition{number}")(x)
        return nnx.relu(self.norm5(x)).mean(axis=(1, 2))


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
