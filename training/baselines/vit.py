"""Vision transformers (Dosovitskiy et al., ICLR 2021) with the module names of timm; layer scales as in DINOv2."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import nnx

__all__ = ["RGBDViT", "VIT_BASE", "VIT_DINOV2_SMALL", "VIT_TINY", "VIT_TINY_4", "ViT", "ViTConfig"]

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


class RGBDViT(nnx.Module):
    """A ViT on colour, a ViT on normals, and a linear classifier of the class tokens of both."""

    def __init__(self, n_classes: int, vit: ViTConfig, size: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `size` is the side of the images, pixels."""
        self.color, self.normals = ViT(vit, size, rngs=rngs), ViT(vit, size, rngs=rngs)
        self.head = nnx.Linear(2 * vit.width, n_classes, rngs=rngs)

    def __call__(self, color: jax.Array, normals: jax.Array) -> jax.Array:
        """Return logits [B, C] for network inputs [B, S, S, 3] of colour and normals."""
        return self.head(jnp.concatenate([self.color(color), self.normals(normals)], axis=-1))
