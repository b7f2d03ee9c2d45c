"""Properties of descriptors and Hypothesis strategies for clouds, to test your own pipeline with.

    from hypothesis import given, settings
    import colornet, thor2_jax as thor2
    from thor2_jax.testing import aligned_clouds, assert_permutation_invariant, packed, seeds

    network, config = colornet.load_default(), thor2.DescriptorConfig()

    @settings(deadline=None)  # the first call compiles
    @given(packed(aligned_clouds(config), size=4, capacity=512), seeds())
    def test_order_of_points(clouds, seed):
        describe = lambda clouds: thor2.describe_aligned(clouds, network, config)
        assert_permutation_invariant(describe, clouds, seed, config)

The package needs the extra `testing`: pip install -c constraints.txt '.[testing]'. All batches of a strategy have the
same shape, so that a property compiles once. Assertions compare bit by bit or with derived tolerances (`comparing`).
"""

from thor2_jax.testing import damage, laws, strategies, values
from thor2_jax.testing.comparing import alignment_drift
from thor2_jax.testing.damage import *
from thor2_jax.testing.laws import *
from thor2_jax.testing.strategies import *
from thor2_jax.testing.values import *

__all__ = ["alignment_drift", *damage.__all__, *laws.__all__, *strategies.__all__, *values.__all__]
