"""The descriptor's numbers that gradients can reach, as one record of arrays.

They enter compiled functions as arguments: other values need no other compilation.

>>> parameters = Parameters.of(network, config)                               # doctest: +SKIP
>>> loss = lambda p: (describe(clouds, network, config, p).tops2**2).sum()    # doctest: +SKIP
>>> jax.grad(loss)(parameters).image_variance                                 # doctest: +SKIP
"""

import dataclasses

import jax
import jax.numpy as jnp

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig

__all__ = ["Parameters"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Parameters:
    """What may be learned of a descriptor. Where given, it takes the place of the same numbers of network and config.

    Attributes:
        similarity: [R, R] float32, Delta of the paper.
        alpha: [] float32, angle in radians of the turn about y. The hard descriptor depends on it through slices and
            strips alone, so its gradient is zero there; the relaxed one's is not.
        sigma_s: [] float32, scaled units per metre.
        image_variance: [] float32, positive: variance of the Gaussian at each point of a diagram.
        persistence_weight: [] float32, exponent n of the weight persistence**n.
    """

    similarity: jax.Array
    alpha: jax.Array
    sigma_s: jax.Array
    image_variance: jax.Array
    persistence_weight: jax.Array

    @classmethod
    def of(cls, network: ColorNetwork, config: DescriptorConfig) -> "Parameters":
        """The values of a network and a config."""
        # Arrays also where a caller's function is being traced, so that they may be kept.
        with jax.ensure_compile_time_eval():
            return cls(
                similarity=jnp.asarray(network.similarity, jnp.float32),
                alpha=jnp.asarray(config.alpha, jnp.float32),
                sigma_s=jnp.asarray(config.sigma_s, jnp.float32),
                image_variance=jnp.asarray(config.image_variance, jnp.float32),
                persistence_weight=jnp.asarray(config.persistence_weight, jnp.float32),
            )
