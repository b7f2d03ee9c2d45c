"""The recognizer's part on the device, in batches of few sizes that are all compiled before the first request."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from numpy.typing import NDArray

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.descriptor.describe import describe_strips, strips
from thor2_jax.descriptor.view_normalization import align
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import Feature
from thor2_jax.recognition.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.recognition.recognizer import THOR2, Recognition, Recognizer
from thor2_jax.recognition.run_directory import load_run
from thor2_jax.service.settings import Settings

__all__ = ["Engine", "Row"]

LEAST_POINTS, LEAST_CLOUDS = 2048, 8
"""Smaller batches are padded to this: they take the device hardly less time, and each size takes seconds to compile."""


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """What the device says of one cloud.

    Attributes:
        images: [S, P, P] float32, persistence images.
        embeddings: [S, R, J] float32, colour embeddings.
        overflow: points and pairs that the descriptor has no room for.
        probabilities: classifier -> [C] float32.
        aligned: [N, 3] float32, the aligned cloud and padding, scaled units.
        strip_colors: [S, J, R] float32, strip colour vectors.
    """

    images: NDArray[np.float32]
    embeddings: NDArray[np.float32]
    overflow: int
    probabilities: dict[Feature, NDArray[np.float32]]
    aligned: NDArray[np.float32]
    strip_colors: NDArray[np.float32]


class Engine:
    """A trained run on the device. Not to be called from several threads at once."""

    def __init__(self, settings: Settings) -> None:
        """Read the run.

        Raises:
            InputError: it cannot be read, or lacks a classifier that THOR2 needs; or as `Recognizer`.
        """
        if settings.cache is not None:
            _keep_compiled(settings.cache)
        run = load_run(settings.model)
        missing = [name for name in THOR2 if name not in run.classifiers]
        if missing:
            raise InputError(f"model: {settings.model} has no classifier {', '.join(missing)}")
        # The same pairs as gudhi's, without a call back from the device.
        self.run = dataclasses.replace(run, config=dataclasses.replace(run.config, homology="closed_form"))
        self.max_batch = settings.max_batch
        self._recognizer = Recognizer(self.run, settings.unknown_below)

    def warm_up(self) -> Iterator[tuple[int, int]]:
        """Compile for every size that `rows` can meet, one (points, clouds) at each step of the iterator."""
        for n_points in (n for n in POINT_BUCKETS if n >= LEAST_POINTS):
            for n_clouds in (b for b in BATCH_BUCKETS if LEAST_CLOUDS <= b <= _batch_size(self.max_batch)):
                self._rows([], n_clouds, n_points)
                yield n_points, n_clouds

    def rows(self, instances: Sequence[PreparedInstance]) -> list[Row]:
        """Describe and classify clouds, at most `max_batch` of them."""
        largest = max(len(instance.points) for instance in instances)
        return self._rows(instances, _batch_size(len(instances)), max(point_bucket(largest), LEAST_POINTS))

    def _rows(self, instances: Sequence[PreparedInstance], n_rows: int, n_points: int) -> list[Row]:
        aligned = align(pack_instances(instances, n_rows, n_points), self.run.config)
        in_strips = strips(aligned, self.run.network, self.run.config)
        found = describe_strips(in_strips, self.run.network, self.run.config)
        probabilities = self._recognizer.probabilities(found, THOR2)
        arrays = (found.images, found.embeddings, found.overflow, aligned.points, in_strips.color)
        images, embeddings, overflow, points, colors = (np.asarray(a) for a in arrays)
        return [
            Row(
                images[k],
                embeddings[k],
                int(overflow[k]),
                {name: p[k] for name, p in probabilities.items()},
                points[k],
                colors[k],
            )
            for k in range(len(instances))
        ]

    def recognitions(self, instances: Sequence[PreparedInstance], rows: Sequence[Row]) -> list[Recognition]:
        """Answers for a frame's instances; `rows` are those of the usable ones, in order."""
        shape = len(rows), len(self.run.classes)
        probabilities = {name: np.reshape([row.probabilities[name] for row in rows], shape) for name in THOR2}
        return self._recognizer.recognitions(instances, probabilities, [row.overflow for row in rows])


def _keep_compiled(folder: Path) -> None:
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By default only what takes a second to compile, and is large, is kept.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _batch_size(n_clouds: int) -> int:
    return max(batch_bucket(n_clouds), LEAST_CLOUDS)
