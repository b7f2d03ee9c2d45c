"""The parameters of the descriptor that can be learned, as one record of arrays.

Compiled functions take them as arguments, so that other values need no compilation.

>>> parameters = Parameters.of(network, config)                               # doctest: +SKIP
>>> loss = lambda p: (describe(clouds, network, config, p).tops2**2).sum()    # doctest: +SKIP
>>> jax.grad(loss)(parameters).image_variance                                 # doctest: +SKIP
"""

import dataclasses

import jax
import numpy as np

from colornet import ColorNetwork
from thor2_jax.config import DescriptorConfig

__all__ = ["Parameters"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Parameters:
    """Learnable parameters of a descriptor, which replace the same numbers of the network and the config.

    Attributes:
        similarity: [R, R] float32, the similarity matrix Delta.
        alpha: [] float32, angle of the turn about y, radians. The hard descriptor depends on it only through the choice
            of slices and strips, so that its gradient is zero; the gradient of a relaxed descriptor is not.
        sigma_s: [] float32, scaled units per metre.
        image_variance: [] float32, positive; variance of the Gaussian at each point of a diagram.
        persistence_weight: [] float32, exponent n of the weight persistence**n.
    """

    similarity: jax.Array
    alpha: jax.Array
    sigma_s: jax.Array
    image_variance: jax.Array
    persistence_weight: jax.Array

    @classmethod
    def of(cls, network: ColorNetwork, config: DescriptorConfig) -> "Parameters":
        """Return the values of a network and a config."""
        # Concrete arrays even while a caller's function is traced, so that they can be cached.
        with jax.ensure_compile_time_eval():
            values = config.alpha, config.sigma_s, config.image_variance, config.persistence_weight
            # By NumPy: JAX would compile a program for each conversion.
            return cls(*(jax.device_put(np.asarray(value, np.float32)) for value in (network.similarity, *values)))
