"""RGB-D ViT (Tziafas and Kasaei, "Early or Late Fusion Matters", IROS 2023): two ViTs, fused late."""

import jax
import jax.numpy as jnp
from flax import nnx

from training.baselines.networks.vit import ViT, ViTConfig

__all__ = ["RGBDViT"]


class RGBDViT(nnx.Module):
    """A ViT on colour, a ViT on normals, and a linear classifier of the class tokens of both."""

    def __init__(self, n_classes: int, vit: ViTConfig, size: int, *, rngs: nnx.Rngs) -> None:
        """Initialize the weights; `size` is the side of the images, pixels."""
        self.color, self.normals = ViT(vit, size, rngs=rngs), ViT(vit, size, rngs=rngs)
        self.head = nnx.Linear(2 * vit.width, n_classes, rngs=rngs)

    def __call__(self, color: jax.Array, normals: jax.Array) -> jax.Array:
        """Return logits [B, C] for network inputs [B, S, S, 3] of colour and normals."""
        return self.head(jnp.concatenate([self.color(color), self.normals(normals)], axis=-1))
