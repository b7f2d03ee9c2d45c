"""The recognizer: from an RGB-D frame to object names (paper, section "Recognition").

>>> recognizer = Recognizer.load("run")                                             # doctest: +SKIP
>>> frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")  # doctest: +SKIP
>>> [(r.label, r.name, r.confidence) for r in recognizer.recognize(frame)]          # doctest: +SKIP
[(1, 'mug', 0.98), (2, 'bowl', 0.71)]

Each instance of the frame is prepared on the host (`prepare_instance`), described (`describe`), classified by the MLPs
of the run and named by the fusion of their probabilities (`fuse`).
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from flax import nnx
from numpy.typing import ArrayLike, NDArray

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.descriptor.describe import describe
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import MLP, Feature, check_features, class_probabilities
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.fusion import DEFAULT_RULE, FUSION_RULES, Fused, FusionRule, fuse
from thor2_jax.recognition.prepared_instance import PreparedInstance, pack_instances, prepare_instance
from thor2_jax.recognition.run_directory import TrainedRun, load_run
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["THOR2", "DescribedFrame", "Recognition", "Recognizer", "concatenate_padded"]

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose fusion is THOR2."""

MAX_OVERFLOW = 0.5
"""Largest overflow of an answer with a name, as a fraction of the points: beyond it, too little is described."""

CHUNK = 4
"""Instances described and classified in one call: while the device computes a chunk, the host prepares the next."""

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Recognition:
    """The answer for one instance of a frame.

    Attributes:
        label: its number in the label image.
        name: the object's name. None if the instance could not be described (fewer points than
            `instance_clouds.MIN_POINTS`), if more than half of its points overflow (`MAX_OVERFLOW`), or if its
            confidence is below the recognizer's `unknown_below`: an unknown object.
        confidence: fused probability of the most probable class, also of an unknown object; None if the instance could
            not be described.
        classifier: the classifier that gives this class the largest probability ("tops" or "tops2").
        top: classifier -> its five most probable (name, probability) pairs.
        occluded: another instance hides a part of it, or the image border cuts it.
        overflow: points and persistence pairs outside the descriptor's grid, see `Descriptors`.
        points_used: points of the described cloud.
        kept_by_fallback: a rule of outlier removal would have dropped most of the cloud and was skipped.
        reason: why `name` is None; None if it is not.
    """

    label: int
    name: str | None = None
    confidence: float | None = None
    classifier: str | None = None
    top: dict[str, list[tuple[str, float]]] = dataclasses.field(default_factory=dict)
    occluded: bool = False
    overflow: int = 0
    points_used: int = 0
    kept_by_fallback: bool = False
    reason: str | None = None


@dataclasses.dataclass(frozen=True)
class DescribedFrame:
    """The instances of a frame and the descriptors of those that can be used.

    Attributes:
        instances: every instance, in the order of the label numbers.
        descriptors: NumPy arrays with one row for each of `usable`, padded to a batch bucket.
    """

    instances: Sequence[PreparedInstance]
    descriptors: Descriptors

    @property
    def usable(self) -> list[PreparedInstance]:
        """The instances that were described, in the order of the rows."""
        return [instance for instance in self.instances if instance.reason is None]

    @property
    def packed(self) -> PointClouds:
        """The described clouds in metres, padded as `descriptors` are."""
        return pack_instances(self.usable, len(self.descriptors.overflow))


class Recognizer:
    """A trained run, ready to recognize the objects of a frame.

    Its functions compile once for each point bucket and batch bucket; `warm_up` compiles them in advance.
    """

    def __init__(self, run: TrainedRun, unknown_below: float = 0.0, rule: FusionRule = DEFAULT_RULE) -> None:
        """Prepare every classifier of `run`.

        Args:
            run: the trained run.
            unknown_below: least confidence, from 0 to 1, of an answer with a name. An object of no trained class tends
                to get less. The report of `thor2 evaluate` has the threshold that keeps 95 % of the answers.
            rule: fusion rule, see `fusion`; the paper's is "max".

        Raises:
            InputError: `unknown_below` is not between 0 and 1, or `rule` is unknown.
        """
        if rule not in FUSION_RULES:
            raise InputError(f"rule is {rule!r}; expected one of {', '.join(FUSION_RULES)}")
        if not 0 <= unknown_below <= 1:
            raise InputError(f"unknown_below is {unknown_below}; expected a confidence from 0 to 1")
        self.run = run
        self.unknown_below = unknown_below
        self.rule: FusionRule = rule
        self._classify = {name: _compiled(name, model) for name, model in run.classifiers.items()}

    @classmethod
    def load(cls, run_dir: str | Path, unknown_below: float = 0.0, rule: FusionRule = DEFAULT_RULE) -> "Recognizer":
        """Read a run directory; raises as `run_directory.load_run` and `Recognizer`."""
        return cls(load_run(run_dir), unknown_below, rule)

    def warm_up(self, max_points: int = 2048, max_instances: int = 16) -> int:
        """Compile everything for frames of up to `max_instances` instances with up to `max_points` points each.

        No such frame compiles anything afterwards. Points are counted on the descriptors' voxel grid (4 mm).

        Returns:
            The number of compiled shapes.

        Raises:
            InputError: a number below 1 or past the largest bucket.
        """
        points = [n for n in POINT_BUCKETS if n <= point_bucket(max_points)]
        rows = [b for b in BATCH_BUCKETS if b <= batch_bucket(max_instances)]
        shapes = [(b, n) for n in points for b in rows if b <= CHUNK]
        described = [describe(pack_instances([], b, n), self.run.network, self.run.config) for b, n in shapes]
        for b in rows:
            self.probabilities(concatenate_padded(described[:1], b))
        return len(shapes) + len(rows)

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
            instance = prepare_instance(frame, label, self.run.config.sigma_s)
            instances.append(instance)
            if instance.reason is None:
                chunk.append(instance)
                if len(chunk) == CHUNK:
                    results.append(compute(chunk))
                    chunk = []
        if chunk or not results:
            results.append(compute(chunk))
        return instances, results

    def _describe_chunk(self, instances: Sequence[PreparedInstance]) -> Descriptors:
        return describe(pack_instances(instances, _padded_rows(len(instances))), self.run.network, self.run.config)

    def probabilities(
        self, descriptors: Descriptors, classifiers: Sequence[Feature] | None = None
    ) -> dict[Feature, NDArray[np.float32]]:
        """Return classifier -> class probabilities [B, C], of all classifiers or of those named."""
        names = self._classify if classifiers is None else classifiers
        computing = {name: self._classify[name](descriptors) for name in names}
        return {name: np.asarray(values) for name, values in computing.items()}

    def recognize(self, frame: RGBDFrame, classifiers: Sequence[Feature] = THOR2) -> list[Recognition]:
        """Recognize every instance of a frame; the answers are in the order of the label numbers.

        Args:
            frame: color, depth, labels and intrinsics.
            classifiers: the classifiers that are fused; by default the paper's two.

        Raises:
            InputError: a classifier that the run does not have. An instance that cannot be described is no error: the
                `reason` of its answer says why.
        """
        names = check_features(classifiers, "classifiers")
        missing = [name for name in names if name not in self._classify]
        if missing:
            raise InputError(f"classifiers: the run has no {', '.join(missing)}, only {', '.join(self._classify)}")

        def compute(instances: Sequence[PreparedInstance]) -> tuple[Any, dict[Feature, Any]]:
            descriptors = self._describe_chunk(instances)
            return descriptors.overflow, {name: self._classify[name](descriptors) for name in names}

        instances, chunks = self._by_chunks(frame, compute)
        n_usable = sum(instance.reason is None for instance in instances)
        overflow, probabilities = concatenate_padded(chunks, _padded_rows(n_usable))
        return self.recognitions(instances, probabilities, overflow)

    def recognitions(
        self,
        instances: Sequence[PreparedInstance],
        probabilities: Mapping[Feature, NDArray[np.float32]],
        overflow: ArrayLike,
    ) -> list[Recognition]:
        """Fuse the classifiers and return the answer for each instance of a frame.

        Args:
            instances: all of them; the usable ones are the first rows of the other arguments, in order.
            probabilities: classifier -> class probabilities [B, C].
            overflow: [B] int, of the descriptors.
        """
        fused, overflows = fuse(probabilities, self.rule), np.asarray(overflow)
        rows = iter(range(len(overflows)))
        return [
            self._recognition(instance, next(rows), fused, probabilities, overflows)
            if instance.reason is None
            else Recognition(instance.label, reason=instance.reason)
            for instance in instances
        ]

    def _recognition(
        self,
        instance: PreparedInstance,
        row: int,
        fused: Fused,
        probabilities: Mapping[Feature, NDArray[np.float32]],
        overflows: NDArray[Any],
    ) -> Recognition:
        confidence, overflow = float(fused.confidence[row]), int(overflows[row])
        reason = None
        if overflow > MAX_OVERFLOW * len(instance.points):
            reason = (
                f"overflow: {overflow} points and pairs of {len(instance.points)} points lie outside the descriptor's "
                "grid; check the intrinsics and the depth scale"
            )
        elif confidence < self.unknown_below:
            reason = f"unknown: a confidence of {confidence:.3f}, below {self.unknown_below:g}"
        return Recognition(
            label=instance.label,
            name=self.run.classes[fused.class_index[row]] if reason is None else None,
            confidence=confidence,
            classifier=str(fused.classifier[row]),
            top={name: self._top(values[row]) for name, values in probabilities.items()},
            occluded=instance.occluded,
            overflow=overflow,
            points_used=len(instance.points),
            kept_by_fallback=instance.kept_by_fallback,
            reason=reason,
        )

    def _top(self, probabilities: NDArray[np.float32], count: int = 5) -> list[tuple[str, float]]:
        best = np.argsort(-probabilities, kind="stable")[:count]
        return [(self.run.classes[i], float(probabilities[i])) for i in best]


def _padded_rows(n: int) -> int:
    """Return the number of rows that `n` instances are padded to: whole largest batches, then a batch bucket."""
    whole = n // BATCH_BUCKETS[-1] * BATCH_BUCKETS[-1]
    return n if n == whole > 0 else whole + batch_bucket(max(n - whole, 1))


def concatenate_padded(batches: Sequence[T], n_rows: int) -> T:
    """Concatenate batches (pytrees of arrays) along the first axis, on the host, with zeros up to `n_rows`."""

    def concatenate(*arrays: jax.Array) -> NDArray[Any]:
        padding = np.zeros((n_rows - sum(map(len, arrays)), *arrays[0].shape[1:]), arrays[0].dtype)
        return np.concatenate([*arrays, padding])

    concatenated: T = jax.tree.map(concatenate, *batches)
    return concatenated


def _compiled(name: Feature, model: MLP) -> Callable[[Descriptors], jax.Array]:
    graph, state = nnx.split(model)
    # As a flat list: JAX would take an nnx state apart, in Python, at every call.
    leaves, structure = jax.tree.flatten(state)

    @jax.jit
    def forward(leaves: list[jax.Array], descriptors: Descriptors) -> jax.Array:
        return class_probabilities(nnx.merge(graph, jax.tree.unflatten(structure, leaves)), descriptors, name)

    return lambda descriptors: forward(leaves, descriptors)
