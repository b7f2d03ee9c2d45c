"""Image networks: ResNet-18, DenseNet, vision transformers, and the networks RCFusion, ViT-CNN and RGB-D ViT.

ResNet-18 (He et al., CVPR 2016) and DenseNet (Huang et al., CVPR 2017) have the module names of torchvision; vision
transformers (Dosovitskiy et al., ICLR 2021; layer scales as in DINOv2) have those of timm.
"""

import dataclasses
import itertools
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

__all__ = ["DENSENET_161", "RCFusion", "RGBDViT", "VIT_BASE", "VIT_DINOV2_SMALL", "VIT_TINY_4", "ViT", "ViTCNN"]

MOMENTUM = 0.9
"""Momentum of the running statistics in all batch normalizations."""

STAGES = (1, 2, 4, 8)
"""Channels of the stages, relative to the first one."""


def batch_norm(channels: int, rngs: nnx.Rngs) -> nnx.BatchNorm:
    """Return a batch normalization layer that follows the training or evaluation mode of its model."""
    return nnx.BatchNorm(channels, momentum=MOMENTUM, epsilon=1e-5, use_running_average=None, rngs=rngs)


def convolution(inputs: int, outputs: int, size: int, stride: int, rngs: nnx.Rngs) -> nnx.Conv:
    """Return a convolution without bias whose output has 1/stride of the input's height and width, as in PyTorch."""
    margin = (size - 1) // 2
    return nnx.Conv(inputs, outputs, (size, size), stride, padding=margin, use_bias=False, rngs=rngs)


def stem_pool(x: jax.Array) -> jax.Array:
    """Return the maxima of windows of 3 x 3 pixels at every second pixel."""
    return nnx.max_pool(x, (3, 3), (2, 2), padding=((1, 1), (1, 1)))


class BasicBlock(nnx.Module):
    """Residual block: two convolutions of 3 x 3 pixels and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; the shortcut is a convolution if the output has another shape than the input."""
        self.conv1 = convolution(inputs, outputs, 3, stride, rngs)
        self.bn1 = batch_norm(outputs, rngs)
        self.conv2 = convolution(outputs, outputs, 3, 1, rngs)
        self.bn2 = batch_norm(outputs, rngs)
        shortcut = stride != 1 or inputs != outputs
        layers = [convolution(inputs, outputs, 1, stride, rngs), batch_norm(outputs, rngs)] if shortcut else []
        self.downsample = nnx.List(layers)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, H/stride, W/stride, outputs] features for [B, H, W, inputs]."""
        y = self.bn2(self.conv2(nnx.relu(self.bn1(self.conv1(x)))))
        for layer in self.downsample:
            x = layer(x)
        return nnx.relu(x + y)


class ResNet18(nnx.Module):
    """A ResNet-18 without its classifier.

    Attributes:
        channels: channels of the four stages' features.
    """

    def __init__(self, width: int = 64, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `width` is the number of channels of the first stage."""
        self.channels = tuple(width * factor for factor in STAGES)
        self.conv1 = convolution(3, width, 7, 2, rngs)
        self.bn1 = batch_norm(width, rngs)
        for number, (inputs, outputs) in enumerate(itertools.pairwise((width, *self.channels)), 1):
            stride = 1 if number == 1 else 2
            blocks = [BasicBlock(inputs, outputs, stride, rngs=rngs), BasicBlock(outputs, outputs, 1, rngs=rngs)]
            setattr(self, f"layer{number}", nnx.List(blocks))

    def __call__(self, x: jax.Array) -> list[jax.Array]:
        """Return the features of the four stages for images [B, S, S, 3]: S/4 to S/32 pixels."""
        x = stem_pool(nnx.relu(self.bn1(self.conv1(x))))
        features = []
        for number in range(1, len(STAGES) + 1):
            for block in getattr(self, f"layer{number}"):
                x = block(x)
            features.append(x)
        return features


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
    """A gated recurrent unit with the same gates and biases as in PyTorch."""

    def __init__(self, inputs: int, memory: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `memory` is the length of the state."""
        self.memory = memory
        self.input = nnx.Linear(inputs, 3 * memory, rngs=rngs)
        self.hidden = nnx.Linear(memory, 3 * memory, rngs=rngs)

    def __call__(self, sequence: jax.Array) -> jax.Array:
        """Return the last state [B, memory] for a sequence [B, T, inputs], starting from state 0."""
        state = jnp.zeros((len(sequence), self.memory), sequence.dtype)
        for step in range(sequence.shape[1]):
            reset_x, update_x, new_x = jnp.split(self.input(sequence[:, step]), 3, axis=-1)
            reset_h, update_h, new_h = jnp.split(self.hidden(state), 3, axis=-1)
            update = nnx.sigmoid(update_x + update_h)
            new = jnp.tanh(new_x + nnx.sigmoid(reset_x + reset_h) * new_h)
            state = (1 - update) * new + update * state
        return state


class RCFusion(nnx.Module):
    """RCFusion: two ResNet-18 networks and a recurrent fusion of their stages."""

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


BOTTLENECK = 4
"""Number of channels between the convolutions of a layer, divided by the number of its output channels."""

DENSENET_161 = {"growth": 48, "blocks": (6, 12, 36, 24)}
"""Arguments of `DenseNet`."""


class DenseLayer(nnx.Module):
    """A bottleneck layer that appends its output to its input."""

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


class Transition(nnx.Module):
    """A transition layer, which halves the channels, the height and the width."""

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
            block: Any = nnx.Dict()
            for layer in range(1, layers + 1):
                block[f"denselayer{layer}"] = DenseLayer(width, growth, rngs=rngs)
                width += growth
            setattr(self, f"denseblock{number}", block)
            if number < len(blocks):
                setattr(self, f"transition{number}", Transition(width, rngs=rngs))
                width //= 2
        self.norm5 = batch_norm(width, rngs)
        self.channels = width

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, channels] features for images [B, S, S, 3]: the means over all pixels."""
        x = stem_pool(nnx.relu(self.norm0(self.conv0(x))))
        for number in range(1, self.n_blocks + 1):
            block = getattr(self, f"denseblock{number}")
            for layer in range(1, len(block) + 1):  # the order of the items changes when a network is merged
                x = block[f"denselayer{layer}"](x)
            if number < self.n_blocks:
                x = getattr(self, f"transition{number}")(x)
        return nnx.relu(self.norm5(x)).mean(axis=(1, 2))


MLP_RATIO = 4
EPSILON = 1e-6
TOKEN_DEVIATION = 0.02


@dataclasses.dataclass(frozen=True)
class ViTConfig:
    """The architecture of a vision transformer.

    Attributes:
        width: length of a token.
        depth: number of blocks.
        heads: attention heads of a block.
        patch: side of a patch, pixels.
        layer_scale: whether the blocks scale their updates of the tokens.
    """

    width: int
    depth: int
    heads: int
    patch: int = 16
    layer_scale: bool = False


VIT_BASE = ViTConfig(768, 12, 12)
VIT_TINY = ViTConfig(192, 12, 3)
VIT_TINY_4 = dataclasses.replace(VIT_TINY, depth=4)
"""The first four blocks of ViT-Ti, which take a third of the time and use the weights of the public file."""
VIT_DINOV2_SMALL = ViTConfig(384, 12, 6, patch=14, layer_scale=True)


class Attention(nnx.Module):
    """Multi-head self-attention."""

    def __init__(self, config: ViTConfig, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.heads = config.heads
        self.qkv = nnx.Linear(config.width, 3 * config.width, rngs=rngs)
        self.proj = nnx.Linear(config.width, config.width, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return tokens [B, T, width] for tokens [B, T, width]."""
        batch, tokens, width = x.shape
        query, key, value = jnp.moveaxis(self.qkv(x).reshape(batch, tokens, 3, self.heads, width // self.heads), 2, 0)
        return self.proj(jax.nn.dot_product_attention(query, key, value).reshape(batch, tokens, width))


class MLP(nnx.Module):
    """A multilayer perceptron with one hidden layer and GELU."""

    def __init__(self, width: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.fc1 = nnx.Linear(width, MLP_RATIO * width, rngs=rngs)
        self.fc2 = nnx.Linear(MLP_RATIO * width, width, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [..., width] for [..., width]."""
        return self.fc2(nnx.gelu(self.fc1(x), approximate=False))


class LayerScale(nnx.Module):
    """A factor for each channel."""

    def __init__(self, width: int) -> None:
        """Initialize all factors to 1."""
        self.gamma = nnx.Param(jnp.ones(width))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return the scaled [..., width]."""
        return x * self.gamma[...]


class Block(nnx.Module):
    """Attention and MLP, each after a normalization and added to its input."""

    def __init__(self, config: ViTConfig, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights."""
        self.norm1 = nnx.LayerNorm(config.width, epsilon=EPSILON, rngs=rngs)
        self.attn = Attention(config, rngs=rngs)
        self.norm2 = nnx.LayerNorm(config.width, epsilon=EPSILON, rngs=rngs)
        self.mlp = MLP(config.width, rngs=rngs)
        self.ls1, self.ls2 = (LayerScale(config.width) if config.layer_scale else nnx.identity for _ in range(2))

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return tokens [B, T, width] for tokens [B, T, width]."""
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class ViT(nnx.Module):
    """A vision transformer without its classifier.

    Attributes:
        channels: length of the features.
    """

    def __init__(self, config: ViTConfig, size: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `size` is the side of the images in pixels, a multiple of the patch's."""
        self.channels = config.width
        tokens = 1 + (size // config.patch) ** 2
        patch = (config.patch, config.patch)
        self.patch_embed = nnx.Dict(proj=nnx.Conv(3, config.width, patch, patch, padding="VALID", rngs=rngs))
        normal = nnx.initializers.normal(TOKEN_DEVIATION)
        self.cls_token = nnx.Param(normal(rngs.params(), (1, 1, config.width)))
        self.pos_embed = nnx.Param(normal(rngs.params(), (1, tokens, config.width)))
        self.blocks = nnx.List([Block(config, rngs=rngs) for _ in range(config.depth)])
        self.norm = nnx.LayerNorm(config.width, epsilon=EPSILON, rngs=rngs)

    def __call__(self, x: jax.Array) -> jax.Array:
        """Return [B, channels] features for images [B, S, S, 3]: the normalized class token."""
        patches = self.patch_embed.proj(x).reshape(len(x), -1, self.channels)
        token = jnp.broadcast_to(self.cls_token[...], (len(x), 1, self.channels))
        tokens = jnp.concatenate([token, patches], axis=1) + self.pos_embed[...]
        for block in self.blocks:
            tokens = block(tokens)
        return self.norm(tokens[:, 0])


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


class RGBDViT(nnx.Module):
    """A ViT on colour, a ViT on normals, and a linear classifier of the class tokens of both."""

    def __init__(self, n_classes: int, vit: ViTConfig, size: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `size` is the side of the images, pixels."""
        self.color, self.normals = ViT(vit, size, rngs=rngs), ViT(vit, size, rngs=rngs)
        self.head = nnx.Linear(2 * vit.width, n_classes, rngs=rngs)

    def __call__(self, color: jax.Array, normals: jax.Array) -> jax.Array:
        """Return logits [B, C] for network inputs [B, S, S, 3] of colour and normals."""
        return self.head(jnp.concatenate([self.color(color), self.normals(normals)], axis=-1))
