"""Properties of descriptors and Hypothesis strategies for clouds, to test your own pipeline with.

    from hypothesis import given
    import colornet, thor2_jax as thor2
    from thor2_jax.testing import aligned_clouds, assert_permutation_invariant, packed, seeds

    network, config = colornet.load_default(), thor2.DescriptorConfig()

    @given(packed(aligned_clouds(config), size=4, capacity=512), seeds())
    def test_order_of_points(clouds, seed):
        describe = lambda clouds: thor2.describe_aligned(clouds, network, config)
        assert_permutation_invariant(describe, clouds, seed, config)

Requires the extra `testing`: pip install -c constraints.txt '.[testing]'. All batches of a strategy have the same
shape, so that a property compiles once. Assertions compare bit by bit or with derived tolerances (`tolerances`).
"""

from thor2_jax.testing.clouds import (
    KINDS,
    aligned_clouds,
    camera_clouds,
    decided_clouds,
    lattice_clouds,
    packed,
    rotations,
    seeds,
)
from thor2_jax.testing.damage import damaged
from thor2_jax.testing.frames import assert_depth_units_agree, assert_labels_are_names, frames
from thor2_jax.testing.laws import (
    assert_backends_agree,
    assert_batch_size_invariant,
    assert_company_invariant,
    assert_duplicates_count_twice,
    assert_flip_follows_rule,
    assert_mirrored_strips,
    assert_object_unity,
    assert_padding_invariant,
    assert_permutation_invariant,
    assert_rigid_motion_invariant,
    assert_same_regions_alike,
    assert_scale_invariant,
    assert_translation_invariant,
)
from thor2_jax.testing.networks import networks
from thor2_jax.testing.reference import reference_descriptor
from thor2_jax.testing.tolerances import alignment_drift
from thor2_jax.testing.values import (
    assert_color_mass,
    assert_embedding_additive,
    assert_embedding_linear,
    assert_follows_equations,
    assert_image_mass,
    assert_overflow_told,
    assert_relaxation_converges,
    assert_stable,
    moved_within_strips,
)

__all__ = [
    "KINDS",
    "aligned_clouds",
    "alignment_drift",
    "assert_backends_agree",
    "assert_batch_size_invariant",
    "assert_color_mass",
    "assert_company_invariant",
    "assert_depth_units_agree",
    "assert_duplicates_count_twice",
    "assert_embedding_additive",
    "assert_embedding_linear",
    "assert_flip_follows_rule",
    "assert_follows_equations",
    "assert_image_mass",
    "assert_labels_are_names",
    "assert_mirrored_strips",
    "assert_object_unity",
    "assert_overflow_told",
    "assert_padding_invariant",
    "assert_permutation_invariant",
    "assert_relaxation_converges",
    "assert_rigid_motion_invariant",
    "assert_same_regions_alike",
    "assert_scale_invariant",
    "assert_stable",
    "assert_translation_invariant",
    "camera_clouds",
    "damaged",
    "decided_clouds",
    "frames",
    "lattice_clouds",
    "moved_within_strips",
    "networks",
    "packed",
    "reference_descriptor",
    "rotations",
    "seeds",
]
