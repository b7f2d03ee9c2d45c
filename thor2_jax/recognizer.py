"""The recognizer: from an RGB-D frame to object names (paper, section "Recognition").

>>> recognizer = Recognizer.load("run")                                             # doctest: +SKIP
>>> frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")  # doctest: +SKIP
>>> [(r.label, r.name, r.confidence) for r in recognizer.recognize(frame)]          # doctest: +SKIP
[(1, 'mug', 0.98), (2, 'bowl', 0.71)]

Each instance of the frame is prepared on the host (`prepare_instance`), described in its candidate orientations
(`describe_orientations`), classified by the networks of the run and named by the fusion of their probabilities
(`fuse`). A gallery recognizes objects without training:

>>> recognizer.enroll("teapot", [frame])                                            # doctest: +SKIP
>>> recognizer.forget("teapot")                                                     # doctest: +SKIP

Its scores name an instance alone, or combined with the classifiers (`ClassUnion.combine`). The answers of several
frames are fused by a `Tracker` (`Recognizer.track`).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.adaptation.answers import fused_classifier, gallery_classifier
from thor2_jax.adaptation.color_transform import ColorTransform
from thor2_jax.adaptation.estimate import Adaptation, Report, estimate_transform
from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.orientations import OrientedDescriptors, describe_orientations
from thor2_jax.errors import InputError, with_context
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.enrollment import instance_view
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.gallery.objects import ObjectGallery
from thor2_jax.gallery.store import GALLERY_DIRECTORY
from thor2_jax.recognition.answers import MAX_OVERFLOW, DescribedFrame, Evidence, Recognition, concatenate_padded
from thor2_jax.recognition.classifier import EMBEDDING, MLP, Feature, oriented_probabilities
from thor2_jax.recognition.confidence import Calibration
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.fusion import DEFAULT_RULE, FUSION_RULES, FusionRule, fused_probabilities
from thor2_jax.recognition.prepared_instance import PreparedInstance, pack_instances, prepare_instance
from thor2_jax.recognition.run_directory import EMBEDDING_FILE, TrainedRun, load_run
from thor2_jax.tracking.tracker import Tracker
from thor2_jax.types import PointClouds

__all__ = [
    "ANSWER_SOURCES",
    "THOR2",
    "AnswerBy",
    "Recognizer",
]

AnswerBy = Literal["classifiers", "gallery", "both"]
ANSWER_SOURCES: tuple[AnswerBy, ...] = ("classifiers", "gallery", "both")
"""What a recognizer may answer by."""

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose fusion is THOR2."""

CHUNK = 4
"""Default of `Recognizer.chunk`."""

Classify = Callable[[OrientedDescriptors], jax.Array]
"""A classifier: from the descriptors of clouds to class probabilities [B, C]."""

T = TypeVar("T")


class Recognizer:
    """A trained run and a gallery, ready to recognize the objects of a frame.

    Attributes:
        run: the trained run.
        objects: the enrolled objects, on disk after `load`.
        unknown_below: least confidence of an answer with any name; None for those of `thresholds`.
        rule: fusion rule of the classifiers.
        calibration: turns fused probabilities into confidences; None in runs without one.
        color_transform: corrects the colours of every instance; from the run's record, or estimated by `adapt`. None
            changes nothing.
        chunk: instances described and classified in one call. While the device computes a chunk, the host prepares the
            next. For a single frame, one large chunk starts sooner, since fewer functions are compiled.

    Its functions compile once for each point bucket and batch bucket; `warm_up` compiles them in advance. Enrolling and
    forgetting objects compiles nothing.
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
    ) -> None:
        """Prepare every classifier of `run`, and an empty gallery in memory.

        Args:
            run: the trained run.
            unknown_below: least confidence, from 0 to 1, of an answer with a name; by default see `thresholds`.
            rule: fusion rule, see `fusion`; the paper's is "max".
            embedding: embedding of the gallery, by default the packaged one. One that was fitted on the run's classes
                is also a classifier.
            answer_by: what answers, see `answers_by`; by default what the run's record stores.
            search: search in the gallery, "exact" or "usearch" (extra `index`), see `Gallery`.

        Raises:
            InputError: `unknown_below` is not between 0 and 1, or `rule` or `answer_by` is unknown.
        """
        if rule not in FUSION_RULES:
            raise InputError(f"rule is {rule!r}; expected one of {', '.join(FUSION_RULES)}")
        self.calibration = Calibration.of_record(run.record)
        if unknown_below is not None and not 0 <= unknown_below <= 1:
            raise InputError(f"unknown_below is {unknown_below}; expected a confidence from 0 to 1")
        self.run = run
        self.unknown_below = unknown_below
        self.color_transform = ColorTransform.of_record(run.record)
        self.chunk = CHUNK
        self.rule: FusionRule = rule
        self.objects = ObjectGallery(run.classes, embedding, search)
        self._answer_by = _check_answer_by(answer_by)
        self._classify: dict[str, Classify] = {name: _compiled(name, m) for name, m in run.classifiers.items()}
        if embedding is not None and embedding.classes == run.classes and run.classifiers:
            self._classify[EMBEDDING] = embedding.class_probabilities

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
    ) -> "Recognizer":
        """Read a run directory; raises as `run_directory.load_run`, `load_gallery` and `Recognizer`.

        Args:
            run_dir: the run directory.
            unknown_below: see `Recognizer`.
            rule: see `Recognizer`.
            gallery: directory of the gallery; by default `gallery` in the run directory. Objects that are enrolled or
                forgotten later are written to it.
            answer_by: see `Recognizer`.
            search: see `Recognizer`.
            reembed: embed the views of the gallery again, after a change of the run's embedding.
        """
        run_dir = Path(run_dir)
        run, file = load_run(run_dir), run_dir / EMBEDDING_FILE
        embedding = Embedding.load(file, run.network) if file.is_file() else None
        recognizer = cls(run, unknown_below, rule, embedding=embedding, answer_by=answer_by, search=search)
        recognizer.objects.open(Path(gallery) if gallery is not None else run_dir / GALLERY_DIRECTORY, reembed=reembed)
        return recognizer

    @property
    def gallery(self) -> Gallery:
        """The enrolled objects."""
        return self.objects.gallery

    @property
    def classes(self) -> tuple[str, ...]:
        """All names that may be answered: trained classes, without forgotten ones, and enrolled objects."""
        return self.objects.union.names

    def answers_by(self, answer_by: str | None = None) -> AnswerBy:
        """Return what answers: "classifiers", "gallery" or "both".

        Args:
            answer_by: the wanted source; by default that of the constructor or of the run's record. Without classifiers
                it is always the gallery, with an empty gallery always the classifiers, and otherwise both by default.
        """
        wanted = _check_answer_by(answer_by) or self._answer_by or _check_answer_by(self.run.record.get("answer_by"))
        if not self._classify:
            return "gallery"
        if not self.gallery.objects:
            return "classifiers"
        return wanted or "both"

    def thresholds(self, answer_by: str | None = None) -> NDArray[np.float64]:
        """Return the least confidence [n] of an answer with each name of `classes`; with `unknown_below`, it is that.

        By default 95 % of the correct answers reach it. That of a class with an output of the classifiers is the run's
        own, measured on held-out views, or 0 in runs without one. That of other objects, and of all where the gallery
        alone answers, depends on the number of their views, see `Gallery.unknown_below`.

        Args:
            answer_by: what answers, see `answers_by`.
        """
        if self.unknown_below is not None:
            return np.full(len(self.classes), self.unknown_below)
        union = self.objects.union
        thresholds = union.of_gallery(self.gallery.unknown_below[None])[0]
        if self.answers_by(answer_by) == "gallery":
            return thresholds
        return np.where(union.has_output, self.calibration.unknown_below if self.calibration else 0.0, thresholds)

    def enroll(
        self,
        name: str,
        frames: Sequence[RGBDFrame | tuple[RGBDFrame, int]],
        *,
        extend: bool = False,
        replace: bool = False,
    ) -> None:
        """Enroll an object from frames, so that the next frame is recognized with it.

        A recognizer from `load` also writes it to the gallery on disk.

        Args:
            name: name of the object.
            frames: frames whose label image has the object as its only instance, or pairs of a frame and the label
                number of the object.
            extend: add the views to those of an object with this name.
            replace: discard the views, and the output of the classifiers, of an object with this name.

        Raises:
            InputError: a frame has several instances and no number, an instance has too few points, or the name exists
                and neither `extend` nor `replace` is given. Nothing is enrolled.
            OSError: the gallery cannot be written; it is as before.
        """
        views = []
        for number, item in enumerate(frames):
            frame, label = item if isinstance(item, tuple) else (item, None)
            with with_context(f"frames[{number}]"):
                views.append(self.corrected(instance_view(frame, label, self.run.config.sigma_s)))
        self.objects.enroll(name, views, "frames", extend=extend, replace=replace)

    def forget(self, name: str) -> None:
        """Forget an object: remove its views, and never answer its trained class again.

        Every answer is then as if the object had not been enrolled.

        Raises:
            InputError: no object has this name.
            OSError: the gallery cannot be written; it is as before.
        """
        self.objects.forget(name)

    def corrected(self, instance: PreparedInstance) -> PreparedInstance:
        """Return an instance with the colours that `color_transform` makes of those of the camera."""
        return instance if self.color_transform is None else self.color_transform.corrected(instance)

    def adapt(self, frames: Iterable[RGBDFrame], report: Report = lambda done, total: None) -> Adaptation:
        """Estimate the colours of a camera from frames without names, and correct them from now on.

        Objects that this recognizer does not know may be among them.

        Args:
            frames: frames of one camera, with instance labels.
            report: function that shows the progress, called with the steps done and their number.

        Returns:
            The estimate; its `transform` is also the new `color_transform`.

        Raises:
            InputError: the frames have different sizes, or fewer than `adaptation.estimate.MIN_INSTANCES` usable
                instances. Nothing changes.
        """
        instances: list[PreparedInstance] = []
        size: tuple[int, ...] = ()
        for number, frame in enumerate(frames):
            size = size or frame.depth.shape
            if frame.depth.shape != size:
                (height, width), (rows, columns) = frame.depth.shape, size
                raise InputError(
                    f"frames[{number}] has {width} x {height} pixels; expected {columns} x {rows}, as the first frame: "
                    "adapt to one camera at a time"
                )
            instances += [prepare_instance(frame, label, self.run.config.sigma_s) for label in frame.instances]
        adaptation = estimate_transform(instances, *self.adaptation_criterion(), report)
        self.color_transform = adaptation.transform
        return adaptation

    def adaptation_criterion(self) -> tuple[ColorNetwork, DescriptorConfig, Classify]:
        """Return the colour network, the descriptor and the classifier whose certainty `adapt` increases.

        It is the embedding, which also knows what is none of the classes; in runs without one, the fused classifiers;
        and the gallery if it answers alone.
        """
        if self.answers_by() == "gallery":
            embedding = self.objects.embedding
            if not self.gallery.objects:
                raise InputError("model has neither classes nor enrolled objects; enroll some first")
            return embedding.network, embedding.config, gallery_classifier(self.gallery, embedding)
        if EMBEDDING in self._classify:
            classify = self._classify[EMBEDDING]
        else:
            classify = fused_classifier([self._classify[name] for name in self.default_classifiers])
        return self.run.network, self.run.config, classify

    def warm_up(self, max_points: int = 2048, max_instances: int = 16) -> int:
        """Compile everything for frames of up to `max_instances` instances with up to `max_points` points each.

        No such frame compiles anything afterwards. Points are counted on the descriptors' voxel grid (4 mm).

        Returns:
            The number of compiled shapes.

        Raises:
            InputError: a number below 1 or past the largest bucket.
        """
        points = [n for n in POINT_BUCKETS if n <= point_bucket(max_points)]
        rows = [b for b in BATCH_BUCKETS if b <= min(batch_bucket(max_instances), self.chunk)]
        shapes = [(b, n) for n in points for b in rows]
        for b, n in shapes:
            self._evidence(pack_instances([], b, n), self.default_classifiers, self.answers_by() != "classifiers")
        return len(shapes)

    def describe(self, frame: RGBDFrame) -> DescribedFrame:
        """Prepare and describe the instances of a frame, of which there may be more than the largest batch bucket."""
        instances, chunks = self._by_chunks(frame, self._describe_chunk)
        n_usable = sum(instance.reason is None for instance in instances)
        return DescribedFrame(instances, concatenate_padded(chunks, _padded_rows(n_usable)))

    def _by_chunks(
        self, frame: RGBDFrame, compute: Callable[[Sequence[PreparedInstance]], T]
    ) -> tuple[list[PreparedInstance], list[T]]:
        """Prepare the instances of a frame and call `compute` on each chunk of usable ones, at least once.

        JAX dispatches asynchronously: the device computes one chunk while the host prepares the next.
        """
        instances: list[PreparedInstance] = []
        chunk: list[PreparedInstance] = []
        results: list[T] = []
        for label in frame.instances:
            instance = self.corrected(prepare_instance(frame, label, self.run.config.sigma_s))
            instances.append(instance)
            if instance.reason is None:
                chunk.append(instance)
                if len(chunk) == self.chunk:
                    results.append(compute(chunk))
                    chunk = []
        if chunk or not results:
            results.append(compute(chunk))
        return instances, results

    def _describe_chunk(self, instances: Sequence[PreparedInstance]) -> OrientedDescriptors:
        return describe_orientations(
            pack_instances(instances, _padded_rows(len(instances))), self.run.network, self.run.config
        )

    @property
    def classifiers(self) -> tuple[str, ...]:
        """Names of the classifiers: those of the run, and "embedding" if its embedding knows the classes."""
        return tuple(self._classify)

    @property
    def default_classifiers(self) -> tuple[str, ...]:
        """The classifiers that answer by default: the paper's two, and the embedding, which gives the confidence."""
        default = tuple(name for name in (*THOR2, EMBEDDING) if name in self._classify)
        return default or self.classifiers

    def probabilities(
        self, oriented: OrientedDescriptors, classifiers: Sequence[str] | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Return classifier -> class probabilities [B, C], of all classifiers or of those named.

        Those of the embedding sum to the probability that an object is one of the classes.
        """
        names = self.classifiers if classifiers is None else classifiers
        computing = {name: self._classify[name](oriented) for name in names}
        return {name: np.asarray(values) for name, values in computing.items()}

    def evidence(
        self, oriented: OrientedDescriptors, classifiers: Sequence[str], clouds: PointClouds | None = None
    ) -> Evidence:
        """Return what clouds are recognized by, as arrays on the device.

        Args:
            oriented: descriptors of the clouds.
            classifiers: classifiers to evaluate; none if the gallery alone answers.
            clouds: [B, N] the clouds in metres, to embed them for the gallery; None if the classifiers alone answer.
        """
        probabilities = {name: self._classify[name](oriented) for name in classifiers}
        if clouds is None:
            return Evidence(oriented.overflow, probabilities)
        embeddings, weights = self.objects.embed(clouds, oriented, self.run.config)
        return Evidence(oriented.overflow, probabilities, embeddings, weights)

    def _evidence(self, clouds: PointClouds, classifiers: Sequence[str], embed: bool) -> Evidence:
        oriented = describe_orientations(clouds, self.run.network, self.run.config)
        return self.evidence(oriented, classifiers, clouds if embed else None)

    def recognize(
        self, frame: RGBDFrame, classifiers: Sequence[str] | None = None, answer_by: str | None = None
    ) -> list[Recognition]:
        """Recognize every instance of a frame; the answers are in the order of the label numbers.

        Args:
            frame: color, depth, labels and intrinsics.
            classifiers: the classifiers that are fused, see `default_classifiers`; the paper's are `THOR2`.
            answer_by: what answers, see `answers_by`.

        Raises:
            InputError: a classifier that the run does not have. An instance that cannot be described is no error: the
                `reason` of its answer says why.
        """
        return self.recognitions(*self.frame_evidence(frame, classifiers, answer_by))

    def track(self) -> Tracker:
        """Return a tracker, which follows the objects of successive frames and fuses the answers for each of them."""
        return Tracker(self)

    def frame_evidence(
        self, frame: RGBDFrame, classifiers: Sequence[str] | None = None, answer_by: str | None = None
    ) -> tuple[list[PreparedInstance], Evidence]:
        """Return the instances of a frame and what the usable ones, the first rows in their order, are recognized by.

        The arguments are those of `recognize`.
        """
        source = self.answers_by(answer_by)
        names = self._check_classifiers(classifiers) if source != "gallery" else ()

        def compute(instances: Sequence[PreparedInstance]) -> Evidence:
            clouds = pack_instances(instances, _padded_rows(len(instances)))
            return self._evidence(clouds, names, source != "classifiers")

        instances, chunks = self._by_chunks(frame, compute)
        n_usable = sum(instance.reason is None for instance in instances)
        return instances, concatenate_padded(chunks, _padded_rows(n_usable))

    def _check_classifiers(self, classifiers: Sequence[str] | None) -> tuple[str, ...]:
        names = self.default_classifiers if classifiers is None else classifiers
        if not isinstance(names, (list, tuple)) or not names or not set(names) <= set(self.classifiers):
            raise InputError(f"classifiers is {names!r}; expected one or more of {', '.join(self.classifiers)}")
        return tuple(dict.fromkeys(names))

    def gallery_scores(self, described: DescribedFrame) -> NDArray[np.float32]:
        """Return the scores [B, n_objects] of the gallery, one row for each row of the descriptors."""
        scores = np.zeros((len(described.oriented.weights), len(self.gallery.names)), np.float32)
        if described.usable:
            embedded = self.objects.embed(described.packed, described.oriented, self.run.config)
            scores[:] = self.gallery.scores(*embedded)
        return scores

    def recognitions(self, instances: Sequence[PreparedInstance], evidence: Evidence) -> list[Recognition]:
        """Fuse the classifiers and the gallery and return the answer for each instance of a frame.

        Args:
            instances: all of them; the usable ones are the first rows of the evidence, in order.
            evidence: what they are recognized by.
        """
        n_usable = sum(instance.reason is None for instance in instances)
        evidence = jax.tree.map(lambda a: np.asarray(a)[:n_usable], evidence)
        embedded = evidence.embeddings, evidence.weights
        scores = evidence.scores if evidence.embeddings is None else self.gallery.scores(*embedded)
        values = self.combined(evidence.probabilities, scores)
        thresholds = self.thresholds("both" if evidence.probabilities else "gallery")
        union = self.objects.union
        by_source = {name: union.of_classifiers(p) for name, p in evidence.probabilities.items()}
        if scores is not None:
            by_source["gallery"] = union.of_gallery(scores)
        rows = iter(range(n_usable))
        return [
            self._recognition(instance, next(rows), values, thresholds, by_source, evidence.overflow)
            if instance.reason is None
            else Recognition(instance.label, reason=instance.reason)
            for instance in instances
        ]

    def fused(self, probabilities: Mapping[str, NDArray[np.float32]]) -> NDArray[np.floating[Any]]:
        """Return the fused class probabilities [B, C] of the classifiers.

        The embedding is not fused with others. Where the run is calibrated, it scales their fused probabilities, so
        that the largest one is the confidence.
        """
        others = {name: values for name, values in probabilities.items() if name != EMBEDDING}
        fused = fused_probabilities(others or probabilities, self.rule)
        if self.calibration is None or EMBEDDING not in probabilities:
            return fused
        return self.calibration.calibrated(fused, probabilities[EMBEDDING])

    def combined(
        self, probabilities: Mapping[str, NDArray[np.float32]], scores: NDArray[np.float32] | None
    ) -> NDArray[np.floating[Any]]:
        """Return the values [B, n] of all `classes`, whose largest one is the answer and its confidence.

        Args:
            probabilities: classifier -> class probabilities [B, C]; empty if the gallery alone answers.
            scores: [B, n_objects] of the gallery; None if the classifiers alone answer.
        """
        if scores is None:
            return self.objects.union.of_classifiers(self.fused(probabilities))
        if not probabilities:
            return self.objects.union.of_gallery(scores)
        return self.objects.union.combine(self.fused(probabilities), scores)

    def _recognition(
        self,
        instance: PreparedInstance,
        row: int,
        values: NDArray[np.floating[Any]],
        thresholds: NDArray[np.float64],
        by_source: Mapping[str, NDArray[Any]],
        overflows: NDArray[Any],
    ) -> Recognition:
        names, overflow = self.classes, int(overflows[row])
        best = int(values[row].argmax()) if names else -1
        confidence = float(values[row, best]) if names else 0.0
        reason = None
        if overflow > MAX_OVERFLOW * len(instance.points):
            reason = (
                f"overflow: {overflow} points and pairs of {len(instance.points)} points lie outside the descriptor's "
                "grid; check the intrinsics and the depth scale"
            )
        elif not names:
            reason = "unknown: no object is enrolled"
        elif confidence < thresholds[best]:
            reason = f"unknown: a confidence of {confidence:.3f}, below {thresholds[best]:g}"
        return Recognition(
            label=instance.label,
            name=names[best] if reason is None else None,
            confidence=confidence,
            classifier=max(by_source, key=lambda name: by_source[name][row, best]) if names else None,
            top={name: _top(names, of_source[row]) for name, of_source in by_source.items()},
            occluded=instance.occluded,
            overflow=overflow,
            points_used=len(instance.points),
            kept_by_fallback=instance.kept_by_fallback,
            reason=reason,
        )


def _check_answer_by(value: str | None) -> AnswerBy | None:
    for source in ANSWER_SOURCES:
        if value == source:
            return source
    if value is not None:
        raise InputError(f"answer_by is {value!r}; expected one of {', '.join(ANSWER_SOURCES)}")
    return None


def _top(names: Sequence[str], values: NDArray[Any], count: int = 5) -> list[tuple[str, float]]:
    best = np.argsort(-values, kind="stable")[:count]
    return [(names[i], float(values[i])) for i in best]


def _padded_rows(n: int) -> int:
    """Return the number of rows that `n` instances are padded to: whole largest batches, then a batch bucket."""
    whole = n // BATCH_BUCKETS[-1] * BATCH_BUCKETS[-1]
    return n if n == whole > 0 else whole + batch_bucket(max(n - whole, 1))


def _compiled(name: Feature, model: MLP) -> Classify:
    """Return the compiled function from descriptors in K orientations to class probabilities [B, C]."""
    graph, state = nnx.split(model)
    # As a flat list: JAX would take an nnx state apart, in Python, at every call.
    leaves, structure = jax.tree.flatten(state)

    @jax.jit
    def forward(leaves: list[jax.Array], oriented: OrientedDescriptors) -> jax.Array:
        return oriented_probabilities(nnx.merge(graph, jax.tree.unflatten(structure, leaves)), oriented, name)

    return lambda oriented: forward(leaves, oriented)
