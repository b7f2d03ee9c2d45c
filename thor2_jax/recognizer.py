"""The recognizer: from an RGB-D frame to object names (paper, section "Recognition").

>>> recognizer = Recognizer.load("run")                                             # doctest: +SKIP
>>> frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")  # doctest: +SKIP
>>> [(r.label, r.name, r.confidence) for r in recognizer.recognize(frame)]          # doctest: +SKIP
[(1, 'mug', 0.98), (2, 'bowl', 0.71)]

Each instance of the frame is prepared on the host (`prepare_instance`), described in several looks
(`describe_looks`), and recognized from the outputs of the model (`infer`, `answers`). A gallery
recognizes objects without training:

>>> recognizer.enroll("teapot", [(frame, 2)])           # the instance with label 2   # doctest: +SKIP
>>> recognizer.forget("teapot")                                                     # doctest: +SKIP

The answers of several frames are fused by a `Tracker` (`Recognizer.track`).
"""

import dataclasses
import functools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thor2_jax.adaptation.estimate import Adaptation, Report, adaptation_criterion, estimate_transform
from thor2_jax.capacity import POINT_BUCKETS, batch_points, point_bucket
from thor2_jax.descriptor.looks import LookDescriptors, describe_looks
from thor2_jax.errors import InputError, with_context
from thor2_jax.files import as_path
from thor2_jax.frames.frames import RGBDFrame, check_frame
from thor2_jax.frames.prepared_instance import PreparedInstance, instance_view, pack_instances, prepare_instance
from thor2_jax.gallery.enrollment import ObjectGallery
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.gallery.store import GALLERY_DIRECTORY
from thor2_jax.model.fusion import DEFAULT_RULE, FusionRule
from thor2_jax.model.inference import MIN_PART, Inference, answers, compute_by_chunks, infer_clouds, padded_rows
from thor2_jax.model.model import ColorTransform, Model
from thor2_jax.model.recognition import Recognition
from thor2_jax.model.run_directory import TrainedRun, load_run
from thor2_jax.networks.embedding import Embedding
from thor2_jax.networks.networks import THOR2
from thor2_jax.segmentation.segmenters import segment
from thor2_jax.surfaces.evidence import compile_comparison, fit_poses
from thor2_jax.tracking.tracker import Tracker
from thor2_jax.types import Descriptors, PointClouds, is_positive_integer

if TYPE_CHECKING:
    from thor2_jax.segmentation.known_objects import Distances  # imports OpenCV

__all__ = ["THOR2", "DescribedFrame", "Recognizer"]

CHUNK = 4
"""Default of `Recognizer.chunk`."""


@dataclasses.dataclass(frozen=True)
class DescribedFrame:
    """The instances of a frame and the descriptors of the usable ones.

    Attributes:
        instances: every instance, in the order of the label numbers.
        oriented: descriptors of all looks, as NumPy arrays with one row for each of `usable`, padded to a batch
            bucket.
    """

    instances: Sequence[PreparedInstance]
    oriented: LookDescriptors

    @property
    def descriptors(self) -> Descriptors:
        """The descriptors of the first look, which are those of the paper."""
        return self.oriented.first

    @property
    def usable(self) -> list[PreparedInstance]:
        """The instances that were described, in the order of the rows."""
        return [instance for instance in self.instances if instance.reason is None]

    @property
    def packed(self) -> PointClouds:
        """The described clouds in metres, padded as `descriptors` are."""
        return pack_instances(self.usable, self.oriented.shape[0], batch_points(len(one.points) for one in self.usable))


def _check_frames(frames: object) -> None:
    if not isinstance(frames, Iterable):
        raise InputError(f"frames is of type {type(frames).__name__}; expected a list of frames")


class Recognizer:
    """A model and its enrolled objects on disk, ready to recognize the objects of a frame.

    Attributes:
        objects: the enrolled objects, an `ObjectGallery`; on disk after `load`.
        chunk: number of instances that are described and classified in one call. While the device computes a chunk, the
            host prepares the next one. Larger chunks need fewer compiled functions, but make each frame slower.

    Functions are compiled once for each point bucket and number of rows (`inference.padded_rows`); `warm_up` compiles
    them in advance. Enrolling and forgetting objects compiles nothing.
    """

    def __init__(
        self,
        run: TrainedRun,
        unknown_below: float | None = None,
        rule: FusionRule = DEFAULT_RULE,
        *,
        embedding: Embedding | None = None,
        answer_by: str | None = None,
        search: str = "exact",
        chunk: int = CHUNK,
    ) -> None:
        """Prepare every classifier of `run`, and an empty gallery in memory.

        Args:
            run: the trained run.
            unknown_below: lowest confidence, from 0 to 1, of an answer with a name; by default see `Model.thresholds`.
            rule: fusion rule, see `fusion`; the paper's is "max".
            embedding: embedding of the gallery; by default that of the run, or the packaged one. An embedding that was
                fitted on the run's classes is also a classifier.
            answer_by: source of the answers, see `Model.answers_by`; by default the source in the run's record.
            search: search in the gallery, "exact" or "usearch" (extra `index`), see `Gallery`.
            chunk: see `Recognizer`.

        Raises:
            InputError: `run` is of another type, `unknown_below` is not between 0 and 1, `chunk` is not a positive
                integer, or `rule` or `answer_by` is unknown.
        """
        if not isinstance(run, TrainedRun):
            raise InputError(f"run is of type {type(run).__name__}; expected a TrainedRun; see Recognizer.load")
        if not is_positive_integer(chunk):
            raise InputError(f"chunk is {chunk!r}; expected a positive integer")
        if embedding is not None:
            run = dataclasses.replace(run, embedding=embedding)
        self._model = Model.of_run(run, unknown_below, rule, answer_by)
        self.chunk = chunk
        self.objects = ObjectGallery(run.classes, run.embedding, search)

    @classmethod
    def load(
        cls,
        run_dir: str | Path,
        unknown_below: float | None = None,
        rule: FusionRule = DEFAULT_RULE,
        *,
        gallery: str | Path | None = None,
        answer_by: str | None = None,
        search: str = "exact",
        reembed: bool = False,
        chunk: int = CHUNK,
    ) -> "Recognizer":
        """Read a run directory; raise errors as `run_directory.load_run`, `load_gallery` and `Recognizer`.

        Args:
            run_dir: the run directory.
            unknown_below: see `Recognizer`.
            rule: see `Recognizer`.
            gallery: directory of the gallery; by default `gallery` in the run directory. Later changes (enrolled and
                forgotten objects) are written to it.
            answer_by: see `Recognizer`.
            search: see `Recognizer`.
            reembed: embed the views of the gallery again, after a change of the run's embedding.
            chunk: see `Recognizer`.
        """
        recognizer = cls(load_run(run_dir), unknown_below, rule, answer_by=answer_by, search=search, chunk=chunk)
        directory = Path(run_dir) / GALLERY_DIRECTORY if gallery is None else as_path(gallery, "gallery")
        recognizer.objects.open(directory, reembed=reembed)
        return recognizer

    @property
    def model(self) -> Model:
        """The current model: the run and the enrolled objects. It can be replaced; a new model's gallery is ignored."""
        gallery = self.objects.gallery
        if self._model.gallery is not gallery:
            self._model = dataclasses.replace(self._model, gallery=gallery)
        return self._model

    @model.setter
    def model(self, model: Model) -> None:
        self._model = model

    @property
    def run(self) -> TrainedRun:
        """The trained run."""
        return self._model.run

    @property
    def gallery(self) -> Gallery:
        """The enrolled objects."""
        return self.objects.gallery

    @property
    def classes(self) -> tuple[str, ...]:
        """All names that an answer can have: trained classes, without forgotten ones, and enrolled objects."""
        return self.model.names

    @property
    def color_transform(self) -> ColorTransform | None:
        """The correction of the camera's colours; None if colours are not corrected."""
        return self._model.color_transform

    def thresholds(self, answer_by: str | None = None) -> NDArray[np.float64]:
        """Return the lowest confidence [n] of an answer with each name of `classes`; see `Model.thresholds`."""
        return self.model.thresholds(answer_by)

    def enroll(
        self,
        name: str,
        frames: Sequence[RGBDFrame | tuple[RGBDFrame, int]],
        *,
        extend: bool = False,
        replace: bool = False,
    ) -> None:
        """Enroll an object from frames; it can be recognized from the next frame on.

        A recognizer from `load` also writes it to the gallery on disk.

        Args:
            name: name of the object.
            frames: frames whose label image has the object as its only instance, or pairs of a frame and the label
                number of the object.
            extend: add the views to an existing object with this name, except for those that it has already.
            replace: discard the views of an object with this name, and the classifiers' output for it.

        Raises:
            InputError: a frame has several instances and no label number is given, an instance has too few points, or
                the name exists and neither `extend` nor `replace` is given. Nothing is enrolled.
            OSError: the gallery cannot be written; it is unchanged.
        """
        _check_frames(frames)
        views = []
        for number, item in enumerate(frames):
            frame, label = item if isinstance(item, tuple | list) and len(item) == 2 else (item, None)
            with with_context(f"frames[{number}]"):
                views.append(self.model.corrected(instance_view(frame, label, self.run.config.sigma_s)))
        self.objects.enroll(name, views, "frames", extend=extend, replace=replace)

    def forget(self, name: str) -> None:
        """Forget an object: remove its views; a trained class is no longer predicted.

        Every answer is then as if the object had not been enrolled.

        Raises:
            InputError: no object has this name.
            OSError: the gallery cannot be written; it is unchanged.
        """
        self.objects.forget(name)

    def adapt(self, frames: Iterable[RGBDFrame], report: Report = lambda done, total: None) -> Adaptation:
        """Estimate the colour transform of a camera from frames without object names, and apply it from now on.

        The frames may also show unknown objects.

        Args:
            frames: frames of one camera, with instance labels.
            report: function that shows the progress, called with the number of steps done and of all steps.

        Returns:
            The estimate, whose `transform` is now part of `model`.

        Raises:
            InputError: a frame has no labels, or the frames have fewer than `adaptation.estimate.MIN_INSTANCES` usable
                instances. Nothing changes.
        """
        _check_frames(frames)
        instances: list[PreparedInstance] = []  # with the camera's colours
        for number, frame in enumerate(frames):
            with with_context(f"frames[{number}]"):
                check_frame(frame)
                instances += [prepare_instance(frame, label, self.run.config.sigma_s) for label in frame.instances]
        adaptation = estimate_transform(instances, adaptation_criterion(self.model), report)
        self.model = dataclasses.replace(self.model, color_transform=adaptation.transform)
        return adaptation

    def warm_up(self, max_points: int = 2048, max_instances: int = 16) -> int:
        """Compile everything for frames of up to `max_instances` instances with up to `max_points` points each.

        No such frame compiles anything afterwards. Points are counted on the descriptors' voxel grid (4 mm).

        Returns:
            The number of compiled shapes.

        Raises:
            InputError: `max_points` exceeds the largest bucket.
        """
        rows = {padded_rows(n, self.chunk) for n in range(1, min(max_instances, self.chunk) + 1)}
        least = batch_points([]) if self.chunk > MIN_PART else 0
        shapes = {(b, max(n, least)) for n in POINT_BUCKETS if n <= point_bucket(max_points) for b in rows}
        for b, n in shapes:
            samples = infer_clouds(self.model, pack_instances([], b, n)).samples
            if samples is not None:
                compile_comparison(samples)
        return len(shapes)

    def prepare(self, frame: RGBDFrame, labels: Iterable[int] | None = None) -> Iterable[PreparedInstance]:
        """Prepare the given instances of a frame (by default all) one by one, with corrected colours.

        Raises:
            InputError: the frame has no labels or, when it is prepared, no such instance.
        """
        check_frame(frame)
        model, config = self.model, self.run.config
        chosen = frame.instances if labels is None else labels
        prepared = (prepare_instance(frame, label, config.sigma_s) for label in chosen)
        return map(model.corrected, prepared)

    def describe(self, frame: RGBDFrame) -> DescribedFrame:
        """Prepare and describe the instances of a frame; their number may exceed the largest batch bucket.

        Raises InputError as `prepare`.
        """
        describe = functools.partial(describe_looks, network=self.run.network, config=self.run.config)
        return DescribedFrame(*compute_by_chunks(self.prepare(frame), self.chunk, describe))

    def recognize(
        self, frame: RGBDFrame, classifiers: Sequence[str] | None = None, answer_by: str | None = None
    ) -> list[Recognition]:
        """Recognize every instance of a frame; the answers are in the order of the label numbers.

        Args:
            frame: color, depth, labels and intrinsics.
            classifiers: the classifiers that are fused, see `Model.chosen_classifiers`; the paper's are `THOR2`.
            answer_by: source of the answers, see `Model.answers_by`.

        Raises:
            InputError: the frame has no labels, the run lacks a classifier of `classifiers`, or `answer_by` is unknown.
                An instance that cannot be described is not an error: the `reason` of its answer explains why.
        """
        return answers(self.model, *self.infer(self.prepare(frame), classifiers, answer_by))

    def segment(self, frame: RGBDFrame) -> NDArray[np.int32]:
        """Segment a frame with the segmenter "table"; split and merge its pieces where the results are known objects.

        This separates objects in a pile, which touch without a visible edge; see `segmentation.known_objects`. Masks
        are fitted to the surfaces of objects with a mesh. The method is a segmenter, so `segmented(frame,
        recognizer.segment)` returns the frame with labels. It needs OpenCV (extra `segment`).

        Returns:
            Labels [H, W]; 0 is background.

        Raises:
            InputError: OpenCV is not installed.
        """
        labels = segment(frame)
        from thor2_jax.segmentation.known_objects import segment_known  # imports OpenCV

        def recognize(frames: Sequence[RGBDFrame]) -> list[tuple[str | None, float]]:
            instances = (each for frame in frames for each in self.prepare(frame, [1]))
            return [(each.name, each.confidence or 0.0) for each in answers(self.model, *self.infer(instances))]

        return segment_known(frame, labels, recognize, self._locate)

    def _locate(self, frame: RGBDFrame) -> dict[int, "Distances"]:
        """Return label -> distances from the surface of the object, for recognized instances whose surface is known."""
        model = self.model
        located: dict[int, Distances] = {}
        if model.run.surfaces is None and not model.gallery.surfaces:
            return located
        instances, inference = self.infer(self.prepare(frame))
        for instance, answer in zip(instances, answers(model, instances, inference), strict=True):
            if answer.name is not None and (known := model.surface_of(answer.name)) is not None:
                surfaces, index = known
                pose = np.asarray(fit_poses(surfaces, pack_instances([instance], 1), [index]))[0]
                located[instance.label] = functools.partial(surfaces.distances, index, pose)
        return located

    def infer(
        self,
        instances: Iterable[PreparedInstance],
        classifiers: Sequence[str] | None = None,
        answer_by: str | None = None,
    ) -> tuple[list[PreparedInstance], Inference]:
        """Evaluate the model on the instances of a frame in chunks.

        Args:
            instances: an iterable that prepares the instances, with corrected colours.
            classifiers: see `recognize`.
            answer_by: see `recognize`.

        Returns:
            All instances, and the outputs for the usable ones: arrays on the host, whose first rows belong to the
            usable instances in order.

        Raises:
            InputError: the run lacks a classifier of `classifiers`.
        """
        compute = functools.partial(infer_clouds, self.model, classifiers=classifiers, answer_by=answer_by)
        return compute_by_chunks(instances, self.chunk, compute)

    def track(self) -> Tracker:
        """Return a tracker, which follows the objects of successive frames and fuses the answers for each of them."""
        return Tracker(self)
