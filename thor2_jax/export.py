"""Export of description and classification as one file of `jax.export` that runs without this package.

>>> blob = export_recognizer(load_run("run"), n_points=2048, n_clouds=8)            # doctest: +SKIP

The file runs with jax alone:

>>> exported = jax.export.deserialize(bytearray(blob))                              # doctest: +SKIP
>>> result = exported.call(points, colors, mask, camera, boundary, rim)              # doctest: +SKIP
>>> result["embedding"], result["overflow"]         # one entry for each classifier  # doctest: +SKIP
"""

from collections.abc import Sequence

import jax
import jax.export
import jax.numpy as jnp

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS
from thor2_jax.errors import InputError
from thor2_jax.model.inference import infer_clouds
from thor2_jax.model.model import Model
from thor2_jax.model.run_directory import TrainedRun
from thor2_jax.types import PointClouds

__all__ = ["PLATFORMS", "export_recognizer"]

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Platform names of `jax.export`: CPUs, NVIDIA and AMD GPUs, TPUs."""


def export_recognizer(run: TrainedRun, n_points: int, n_clouds: int, platforms: Sequence[str] = ("cpu",)) -> bytes:
    """Export the function from clouds of one padded size to class probabilities, weights included.

    Diagrams are computed in closed form, since a host callback cannot be exported; the values are the same.

    Args:
        run: the trained run.
        n_points: N, one of `capacity.POINT_BUCKETS`.
        n_clouds: B, one of `capacity.BATCH_BUCKETS`.
        platforms: platforms to run on, from `PLATFORMS`.

    Returns:
        Serialized `jax.export.Exported`: a function of six fields of `PointClouds` (points [B, N, 3], colors [B, N, 3],
        mask [B, N], camera [B, 3], boundary [B, N], rim [B, N]) that returns a dictionary with the class probabilities
        [B, C] of each classifier and overflow [B]. An embedding that recognizes the classes is the classifier
        "embedding"; its probabilities sum to the probability that the object is one of the classes.
        In a run with surfaces, they include the comparison, which needs the points of a cloud before its padding. What
        the camera sees around an instance is not compared.

    Raises:
        InputError: `run` is of another type or has no classes, a size is not a bucket, or a platform is unknown.
    """
    if not isinstance(run, TrainedRun):
        raise InputError(f"run is of type {type(run).__name__}; expected a TrainedRun, as load_run returns it")
    for name, value, buckets in (("n_points", n_points, POINT_BUCKETS), ("n_clouds", n_clouds, BATCH_BUCKETS)):
        if value not in buckets:
            raise InputError(f"{name} is {value!r}; expected one of {', '.join(map(str, buckets))}")
    if not platforms or not set(platforms) <= set(PLATFORMS):
        raise InputError(f"platforms is {tuple(platforms)!r}; expected some of {', '.join(PLATFORMS)}")
    model = Model.of_run(run.without_callback())
    if not model.classifiers:
        raise InputError("run has no classes, and enrolled objects cannot be exported; expected a run of thor2 train")

    def recognize(*fields: jax.Array) -> dict[str, jax.Array]:
        inference = infer_clouds(model, PointClouds(*fields), tuple(model.classifiers))
        return {"overflow": inference.overflow, **inference.probabilities}

    shape = jax.ShapeDtypeStruct
    vectors, flags = shape((n_clouds, n_points, 3), jnp.float32), shape((n_clouds, n_points), jnp.bool_)
    camera = shape((n_clouds, 3), jnp.float32)
    exported = jax.export.export(jax.jit(recognize), platforms=platforms)(vectors, vectors, flags, camera, flags, flags)
    return bytes(exported.serialize())
