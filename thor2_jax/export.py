"""A recognizer's pure part as one file that needs none of this code: described and classified by `jax.export`.

>>> blob = export_recognizer(load_run("run"), n_points=2048, n_clouds=8)            # doctest: +SKIP

Wherever jax is, and without `thor2_jax`:

>>> exported = jax.export.deserialize(bytearray(blob))                              # doctest: +SKIP
>>> found = exported.call(points, colors, mask, camera, boundary)                   # doctest: +SKIP
>>> found["tops"], found["tops2"], found["overflow"]                                # doctest: +SKIP
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.export
import jax.numpy as jnp

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS
from thor2_jax.descriptor.describe import describe
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import class_probabilities
from thor2_jax.recognition.run_directory import TrainedRun
from thor2_jax.types import PointClouds

__all__ = ["PLATFORMS", "export_recognizer"]

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Names that `jax.export` has for CPUs, NVIDIA and AMD GPUs, and TPUs."""


def export_recognizer(run: TrainedRun, n_points: int, n_clouds: int, platforms: Sequence[str] = ("cpu",)) -> bytes:
    """Clouds to class probabilities, for one padded size, weights included, as a serialized `jax.export.Exported`.

    Diagrams are in closed form: a host callback cannot be exported, and both give the same values.

    Args:
        run: trained.
        n_points: N, one of `capacity.POINT_BUCKETS`.
        n_clouds: B, one of `capacity.BATCH_BUCKETS`.
        platforms: on which it can run, of `PLATFORMS`.

    Returns:
        Bytes of a function of the fields of `PointClouds` (points [B, N, 3], colors [B, N, 3], mask [B, N],
        camera [B, 3], boundary [B, N]) that gives a dictionary: class probabilities [B, C] of each classifier, and
        overflow [B].

    Raises:
        InputError: sizes that are no buckets, or no such platforms.
    """
    for name, value, buckets in (("n_points", n_points, POINT_BUCKETS), ("n_clouds", n_clouds, BATCH_BUCKETS)):
        if value not in buckets:
            raise InputError(f"{name} is {value!r}; expected one of {', '.join(map(str, buckets))}")
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise InputError(f"platforms is {tuple(platforms)!r}; expected some of {', '.join(PLATFORMS)}")
    config = dataclasses.replace(run.config, homology="closed_form")

    def recognize(*fields: jax.Array) -> dict[str, jax.Array]:
        found = describe(PointClouds(*fields), run.network, config)
        return {
            "overflow": found.overflow,
            **{name: class_probabilities(model, found, name) for name, model in run.classifiers.items()},
        }

    shape = jax.ShapeDtypeStruct
    vectors, flags = shape((n_clouds, n_points, 3), jnp.float32), shape((n_clouds, n_points), jnp.bool_)
    camera = shape((n_clouds, 3), jnp.float32)
    exported = jax.export.export(jax.jit(recognize), platforms=platforms)(vectors, vectors, flags, camera, flags)
    return bytes(exported.serialize())
