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

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from colornet import ColorNetwork
from thor2_jax.adaptation.answers import fused_classifier, gallery_classifier
from thor2_jax.adaptation.color_transform import ColorTransform
from thor2_jax.adaptation.estimate import Adaptation, Report, camera_instances, estimate_transform
from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.config import DescriptorConfig
from thor2_jax.descriptor.orientations import OrientedDescriptors, describe_orientations
from thor2_jax.errors import InputError
from thor2_jax.gallery.embedding import Embedding
from thor2_jax.gallery.enrollment import instance_views
from thor2_jax.gallery.gallery import Gallery
from thor2_jax.gallery.objects import ObjectGallery
from thor2_jax.gallery.store import GALLERY_DIRECTORY
from thor2_jax.recognition.answers import AnswerBy, DescribedFrame, Evidence, Recognition, check_answer_by
from thor2_jax.recognition.chunks import compute_by_chunks
from thor2_jax.recognition.classifier import EMBEDDING
from thor2_jax.recognition.confidence import Calibration
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.fusion import DEFAULT_RULE, FUSION_RULES, FusionRule, fused_probabilities
from thor2_jax.recognition.naming import name_instances
from thor2_jax.recognition.prepared_instance import PreparedInstance, pack_instances, prepare_instance
from thor2_jax.recognition.run_classifiers import THOR2, Classifier, RunClassifiers
from thor2_jax.recognition.run_directory import EMBEDDING_FILE, TrainedRun, load_run
from thor2_jax.tracking.tracker import Tracker
from thor2_jax.types import PointClouds

__all__ = ["THOR2", "AnswerBy", "Recognizer"]

CHUNK = 4
"""Default of `Recognizer.chunk`."""


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
        self._answer_by = check_answer_by(answer_by)
        knows_classes = embedding is not None and embedding.classes == run.classes and bool(run.classifiers)
        self._classifiers = RunClassifiers.compiled(
            run.classifiers, embedding.class_probabilities if embedding is not None and knows_classes else None
        )

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
        wanted = check_answer_by(answer_by) or self._answer_by or check_answer_by(self.run.record.get("answer_by"))
        if not self._classifiers:
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
        views = [self.corrected(view) for view in instance_views(frames, self.run.config.sigma_s)]
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
        instances = camera_instances(frames, self.run.config.sigma_s)
        adaptation = estimate_transform(instances, *self.adaptation_criterion(), report)
        self.color_transform = adaptation.transform
        return adaptation

    def adaptation_criterion(self) -> tuple[ColorNetwork, DescriptorConfig, Classifier]:
        """Return the colour network, the descriptor and the classifier whose certainty `adapt` increases.

        It is the embedding, which also knows what is none of the classes; in runs without one, the fused classifiers;
        and the gallery if it answers alone.
        """
        if self.answers_by() == "gallery":
            embedding = self.objects.embedding
            if not self.gallery.objects:
                raise InputError("model has neither classes nor enrolled objects; enroll some first")
            return embedding.network, embedding.config, gallery_classifier(self.gallery, embedding)
        classify = self._classifiers.get(EMBEDDING) or fused_classifier(
            [self._classifiers[name] for name in self.default_classifiers]
        )
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

        def compute(clouds: PointClouds) -> OrientedDescriptors:
            return describe_orientations(clouds, self.run.network, self.run.config)

        return DescribedFrame(*compute_by_chunks(self._prepared(frame), self.chunk, compute))

    def _prepared(self, frame: RGBDFrame) -> Iterator[PreparedInstance]:
        for label in frame.instances:
            yield self.corrected(prepare_instance(frame, label, self.run.config.sigma_s))

    @property
    def classifiers(self) -> tuple[str, ...]:
        """Names of the classifiers: those of the run, and "embedding" if its embedding knows the classes."""
        return tuple(self._classifiers)

    @property
    def default_classifiers(self) -> tuple[str, ...]:
        """The classifiers that answer by default: the paper's two, and the embedding, which gives the confidence."""
        return self._classifiers.default

    def probabilities(
        self, oriented: OrientedDescriptors, classifiers: Sequence[str] | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Return classifier -> class probabilities [B, C], of all classifiers or of those named.

        Those of the embedding sum to the probability that an object is one of the classes.
        """
        names = self.classifiers if classifiers is None else classifiers
        computing = self._classifiers.probabilities(oriented, names)
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
        probabilities = self._classifiers.probabilities(oriented, classifiers)
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
        return self.evidence_of(self._prepared(frame), classifiers, answer_by)

    def evidence_of(
        self,
        instances: Iterable[PreparedInstance],
        classifiers: Sequence[str] | None = None,
        answer_by: str | None = None,
    ) -> tuple[list[PreparedInstance], Evidence]:
        """Return instances, whose colours are corrected already, and what the usable ones are recognized by.

        The other arguments are those of `recognize`.
        """
        source = self.answers_by(answer_by)
        names = self._classifiers.checked(classifiers) if source != "gallery" else ()

        def compute(clouds: PointClouds) -> Evidence:
            return self._evidence(clouds, names, source != "classifiers")

        return compute_by_chunks(instances, self.chunk, compute)

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
        return name_instances(instances, self.classes, values, thresholds, by_source, evidence.overflow)

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
