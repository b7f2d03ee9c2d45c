"""Comparison of descriptors, and rearrangement of batches."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from thor2_jax.config import DescriptorConfig
from thor2_jax.testing.tolerances import embedding_rounding, image_lipschitz, image_rounding
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["assert_equal", "assert_near", "cloud_of", "joined", "taken", "with_points"]


def with_points(clouds: PointClouds, points: NDArray[np.floating]) -> PointClouds:
    """Replace the points [B, N, 3] of clouds, rounded to float32, with padding set to 0."""
    kept = np.where(np.asarray(clouds.mask)[..., None], points, 0)
    return dataclasses.replace(clouds, points=jnp.asarray(kept, jnp.float32))


def cloud_of(clouds: PointClouds, index: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return points [n, 3] and 8-bit colours [n, 3] of one cloud, without padding."""
    mask = np.asarray(clouds.mask[index])
    colors = np.asarray(clouds.colors[index])[mask]
    return np.asarray(clouds.points[index])[mask], np.floor(colors * 255 + 0.5).astype(np.uint8)


def assert_equal(actual: Descriptors, expected: Descriptors) -> None:
    """Assert that descriptors are finite and equal bit by bit."""
    for field in dataclasses.fields(Descriptors):
        a, b = (np.asarray(getattr(d, field.name)) for d in (actual, expected))
        assert np.isfinite(b).all(), f"{field.name}: {int((~np.isfinite(b)).sum())} numbers are not finite"
        np.testing.assert_array_equal(a, b, err_msg=field.name)


def assert_near(
    actual: Descriptors, expected: Descriptors, config: DescriptorConfig, drift: float = 0.0, strips: int | None = None
) -> None:
    """Assert that descriptors are equal up to rounding, if each aligned point moved by at most `drift` in its strip.

    Births and counts are then equal, and each persistence changes by at most 2 `drift`. An image, summed over its
    pixels, changes by that times its Lipschitz constant plus twice its rounding error; an embedding changes by rounding
    only. The sum of persistences is estimated from the image, which has at least 0.47 of the mass of each pair.

    Args:
        actual: descriptors.
        expected: descriptors with a non-negative similarity.
        config: the config of both.
        drift: scaled units.
        strips: largest number of pairs in a slice; by default all strips.
    """
    np.testing.assert_array_equal(actual.overflow, expected.overflow, err_msg="overflow")
    images, others = (np.asarray(d.images, np.float64) for d in (expected, actual))
    persistence = images.sum(axis=(-2, -1)) / 0.47
    pairs = config.n_strips if strips is None else strips
    moved = 2 * drift * (pairs - 1 + image_lipschitz(persistence, config))
    off = np.abs(others - images).sum(axis=(-2, -1))
    bound = moved + 2 * image_rounding(persistence, config)
    assert (off <= bound).all(), (
        f"images: off by {off.max():.3g}, summed over the pixels; bound {bound[off > bound][0]:.3g}"
    )
    colors = np.asarray(expected.embeddings, np.float64)
    off = np.abs(np.asarray(actual.embeddings, np.float64) - colors)
    bound = 2 * embedding_rounding(colors.shape[-2]) * np.abs(colors)
    assert (off <= bound).all(), f"embeddings: off by {off.max():.3g}"


def joined(*batches: PointClouds) -> PointClouds:
    """Unite the points of batches: cloud b has the points of cloud b of each batch."""
    names = ("points", "colors", "mask", "boundary")
    together = {name: jnp.concatenate([getattr(b, name) for b in batches], axis=1) for name in names}
    return dataclasses.replace(batches[0], **together)


def taken(clouds: PointClouds, order: NDArray[np.intp]) -> PointClouds:
    """Select the points of each cloud with the indices `order`, [M] or [B, M]; cameras are unchanged."""
    rows = np.broadcast_to(order, (len(clouds.mask), order.shape[-1]))

    def reorder(a: jax.Array) -> jax.Array:
        index = rows if a.ndim == 2 else rows[..., None]
        return jnp.take_along_axis(a, jnp.asarray(index), axis=1)

    per_point = {name: reorder(getattr(clouds, name)) for name in ("points", "colors", "mask", "boundary")}
    return dataclasses.replace(clouds, **per_point)
