"""The compiled model and the single thread that runs it, with batches shared between waiting requests.

All batch sizes are compiled before serving.
"""

import dataclasses
import logging
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from thor2_jax.adaptation.estimate import Adaptation, OnlineAdaptation, adaptation_criterion
from thor2_jax.capacity import BATCH_BUCKETS, MIN_BATCH_POINTS, POINT_BUCKETS, batch_bucket, batch_points
from thor2_jax.descriptor.describe import strips
from thor2_jax.descriptor.looks import aligned_looks, describe_aligned_looks
from thor2_jax.errors import InputError
from thor2_jax.explanation.explain import explained_by_classifiers
from thor2_jax.frames.prepared_instance import PreparedInstance, pack_instances
from thor2_jax.gallery.store import GALLERY_DIRECTORY, check_exists, check_open_to_changes
from thor2_jax.model.inference import Inference, answers, infer
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition
from thor2_jax.recognizer import Recognizer
from thor2_jax.service.settings import Settings
from thor2_jax.surfaces.evidence import compile_comparison

__all__ = ["Batcher", "CloudResult", "ExplanationPrograms", "InferenceEngine", "recognize"]

log = logging.getLogger(__name__)

MIN_BATCH_BUCKET = 8
"""Smallest padded number of clouds of a batch; smaller sizes are hardly faster, and each takes seconds to compile."""

ExplanationPrograms = tuple[int, bool]
"""Padded number of points and kind of scores (`explained_by_classifiers`) of programs for explanations."""


class CloudResult(NamedTuple):
    """Descriptor and class probabilities of one cloud, or of a batch of clouds with one more axis.

    Attributes:
        images: [S, P, P] float32, persistence images.
        embeddings: [S, R, J] float32, colour embeddings.
        aligned: [N, 3] float32, the aligned cloud in scaled units, with padding.
        strip_colors: [S, J, R] float32, strip colour vectors.
        inference: outputs of the model, without the batch axis.
    """

    images: NDArray[np.float32]
    embeddings: NDArray[np.float32]
    aligned: NDArray[np.float32]
    strip_colors: NDArray[np.float32]
    inference: Inference


Job = tuple[Sequence[PreparedInstance], Future[list[CloudResult]]]
"""The usable instances of a request, and their results."""


class Batcher:
    """A thread that processes the instances of requests; instances that arrive meanwhile share the next batches."""

    def __init__(self, process_batch: Callable[[list[PreparedInstance]], list[CloudResult]], max_batch: int) -> None:
        """Create the thread.

        Args:
            process_batch: function that returns one result per instance, for at most `max_batch` instances.
            max_batch: largest number of instances in a batch.
        """
        self._process_batch, self._max_batch = process_batch, max_batch
        self._waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
        self._device = ThreadPoolExecutor(1, thread_name_prefix="device")

    def submit(self, instances: Sequence[PreparedInstance]) -> Future[list[CloudResult]]:
        """Queue `instances` and return a future of their results, in order; cancelled futures are skipped."""
        future = Future[list[CloudResult]]()
        self._waiting.put((instances, future))
        self._device.submit(self._process)
        return future

    def close(self) -> None:
        """Process all submitted instances and stop the thread."""
        self._device.shutdown()

    def _process(self) -> None:
        """Process the waiting instances, unless an earlier call has included them in its batch."""
        jobs: list[Job] = []
        instances: list[PreparedInstance] = []
        while len(instances) < self._max_batch and not self._waiting.empty():
            job = self._waiting.get()
            if job[1].set_running_or_notify_cancel():
                jobs.append(job)
                instances += job[0]
        results: list[CloudResult] = []
        try:
            for first in range(0, len(instances), self._max_batch):
                results += self._process_batch(instances[first : first + self._max_batch])
        except Exception as error:  # The callers receive the error; the thread continues with the next batch.
            for _, future in jobs:
                future.set_exception(error)
            return
        for of_job, future in jobs:
            future.set_result(results[: len(of_job)])
            del results[: len(of_job)]


class InferenceEngine:
    """A trained run on the device. Not thread-safe.

    Attributes:
        objects: the enrolled objects. Change a copy of them in another thread, and call `refresh` in this one.
        max_batch: largest number of clouds in a batch.
    """

    def __init__(self, settings: Settings) -> None:
        """Load the run.

        Raises:
            InputError: the given gallery does not exist and `teach` is not set, or the gallery cannot be written and
                `teach` is set; also as `Recognizer.load` and, with `adapt`, as `adaptation_criterion`.
        """
        if settings.cache is not None:
            jax.config.update("jax_compilation_cache_dir", str(settings.cache))
            # By default JAX caches only programs that take more than a second to compile.
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        directory = settings.gallery or settings.model / GALLERY_DIRECTORY
        if not settings.teach:
            check_exists(settings.gallery)
        self._recognizer = recognizer = Recognizer.load(settings.model, settings.unknown_below, gallery=directory)
        self.objects = recognizer.objects
        if settings.teach:
            check_open_to_changes(directory)
        model = dataclasses.replace(recognizer.model, run=recognizer.run.without_callback())
        if settings.teach and model.answer_by == "classifiers":  # They ignore enrolled objects.
            model = dataclasses.replace(model, answer_by="both")
        recognizer.model = model
        # With `teach`, the embedding is compiled before the first object is enrolled.
        self._embeds = settings.teach or self.model.answers_by() != "classifiers"
        self._last_error = ""
        self.max_batch = settings.max_batch
        self._online = OnlineAdaptation(lambda: adaptation_criterion(self.model)) if settings.adapt else None

    @property
    def model(self) -> Model:
        """The current model, whose descriptors are computed without a host callback."""
        return self._recognizer.model

    @property
    def adaptation(self) -> Adaptation | None:
        """The latest estimate of the camera's colour transform; None before the first estimate and without `adapt`."""
        return None if self._online is None else self._online.latest

    def correct(self, instances: Sequence[PreparedInstance], *, observe: bool) -> list[PreparedInstance]:
        """Return the instances of a frame with corrected colours.

        Args:
            instances: instances with the camera's colours.
            observe: also use them to estimate the camera's colour transform, with `adapt`.
        """
        if observe and self._online is not None:
            self._online.observe(instances)
        model = self.model
        if self.adaptation is not None:
            model = dataclasses.replace(model, color_transform=self.adaptation.transform)
        return [model.corrected(instance) for instance in instances]

    def read_gallery(self) -> None:
        """Read the gallery again if a process has changed it.

        The gallery is not read again if it was empty at the start and `teach` is not set, since clouds are not embedded
        then.

        Raises:
            InputError, OSError: the gallery cannot be read; the one in memory is unchanged.
        """
        if self._embeds:
            self.objects.refresh()

    def refresh(self) -> None:
        """Read the gallery again as `read_gallery`; if it cannot be read, log the error."""
        try:
            self.read_gallery()
            self._last_error = ""
        except (InputError, OSError) as error:
            if str(error) != self._last_error:
                log.error("%s", error)
            self._last_error = str(error)

    @property
    def batch_shapes(self) -> list[tuple[int, int]]:
        """Every batch shape that `infer` can use, as (clouds, points)."""
        batches = [b for b in BATCH_BUCKETS if MIN_BATCH_BUCKET <= b <= _padded_batch(self.max_batch)]
        return [(b, n) for n in POINT_BUCKETS if n >= MIN_BATCH_POINTS for b in batches]

    def compile_adaptation(self) -> None:
        """Compile the programs of the adaptation, with `adapt`."""
        if self._online is not None:
            self._online.compile()

    def infer(self, instances: Sequence[PreparedInstance], shape: tuple[int, int] | None = None) -> list[CloudResult]:
        """Describe and classify at most `max_batch` clouds, in one of `batch_shapes`: by default the smallest.

        Without clouds, the programs for this shape are compiled.
        """
        n_points = batch_points(len(instance.points) for instance in instances)
        clouds = pack_instances(instances, *(shape or (_padded_batch(len(instances)), n_points)))
        network, config = self.model.run.network, self.model.run.config
        aligned = aligned_looks(clouds, config, config.looks)
        cloud_strips = strips(aligned, network, config)
        oriented = describe_aligned_looks(aligned, cloud_strips, network, config, config.looks)
        inference = infer(self.model, oriented, clouds, embeds=self._embeds)
        first = slice(None, None, config.looks)
        described = oriented.first.images, oriented.first.embeddings, aligned.points[first], cloud_strips.color[first]
        batch = CloudResult(*jax.tree.map(np.asarray, (*described, inference)))
        if not instances and batch.inference.samples is not None:  # a mesh may be enrolled later
            compile_comparison(batch.inference.samples)
        return [jax.tree.map(lambda a, k=k: a[k], batch) for k in range(len(instances))]

    def explanation_programs(self, n_points: int = 1) -> list[ExplanationPrograms]:
        """Return the programs that explain answers for clouds of `n_points` points."""
        return [(batch_points([n_points]), kind) for kind in dict.fromkeys(explained_by_classifiers(self.model))]


def recognize(model: Model, instances: Sequence[PreparedInstance], results: Sequence[CloudResult]) -> list[Recognition]:
    """Return a recognition per instance of a frame; `results` belong to the usable instances in order."""
    if not results:
        return [Recognition(instance.label, reason=instance.reason) for instance in instances]
    inference = jax.tree.map(lambda *rows: np.stack(rows), *[result.inference for result in results])
    source = model.answers_by()  # A change of the gallery may change it.
    if source == "classifiers":
        inference = inference._replace(embeddings=None)
    elif source == "gallery":
        inference = inference._replace(probabilities={})
    return answers(model, instances, inference)


def _padded_batch(n_clouds: int) -> int:
    return max(batch_bucket(n_clouds), MIN_BATCH_BUCKET)
