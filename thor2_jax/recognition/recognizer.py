"""From an RGB-D frame to object names (paper, section "Recognition"): clouds, descriptors, two classifiers, one answer.

>>> recognizer = Recognizer.load("run")                                             # doctest: +SKIP
>>> frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")  # doctest: +SKIP
>>> [(r.label, r.name, r.confidence) for r in recognizer.recognize(frame)]          # doctest: +SKIP
[(1, 'mug', 0.98), (2, 'bowl', 0.71)]
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeVar

import jax
import numpy as np
from flax import nnx
from numpy.typing import ArrayLike, NDArray

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.descriptor.describe import describe
from thor2_jax.errors import InputError
from thor2_jax.recognition.classifier import (
    DEFAULT_RULE,
    MLP,
    RULES,
    Feature,
    Rule,
    check_features,
    class_probabilities,
    join,
)
from thor2_jax.recognition.frames import RGBDFrame
from thor2_jax.recognition.instance_clouds import InstanceCloud, instance_cloud
from thor2_jax.recognition.occlusion import find_occlusion
from thor2_jax.recognition.run_directory import TrainedRun, load_run
from thor2_jax.recognition.voxel_grid import downsample_to_fit
from thor2_jax.types import Descriptors, PointClouds

__all__ = ["NO_PART", "THOR2", "VOXEL", "DescribedFrame", "Part", "Recognition", "Recognizer", "pack_parts", "prepare"]

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose joint answer is THOR2's."""

T = TypeVar("T")

VOXEL = 0.01
"""Voxel side in scaled units of every cloud that is described, in training too: colour counts depend on it."""


@dataclasses.dataclass(frozen=True)
class Recognition:
    """What is said of one instance of a frame.

    Attributes:
        label: its number in the label image.
        name: the object's name; None if it was not recognized or is unknown.
        confidence: the name's probability by all classifiers asked together.
        classifier: which of them is surest of the name ("tops" or "tops2").
        top: classifier -> its five most probable (name, probability) pairs.
        occluded: the instance is hidden in part by another one, or cut by the image's border.
        overflow: points and pairs that the descriptor has no room for.
        points_used: points of the described cloud.
        kept_by_fallback: the outlier filter would have emptied the cloud and was relaxed.
        reason: why it has no name; None if it has one.
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


@dataclasses.dataclass(frozen=True, eq=False)
class Part:
    """What is described of an instance, on the descriptors' grid.

    Attributes:
        occluded: it is hidden in part.
        points: [n, 3] float32, metres.
        colors: [n, 3] uint8, sRGB.
        boundary: [n] bool, points on the occlusion boundary.
    """

    occluded: bool
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    boundary: NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class DescribedFrame:
    """A frame's instances and the descriptors of the usable ones, row by row.

    Attributes:
        clouds: every instance; unusable ones carry a reason.
        usable: indices into `clouds`, one a row of `descriptors`.
        parts: what was described, one a row.
        descriptors: NumPy arrays, padded to a batch bucket; rows past `parts` are of no cloud.
    """

    clouds: list[InstanceCloud]
    usable: list[int]
    parts: list[Part]
    descriptors: Descriptors

    @property
    def packed(self) -> PointClouds:
        """The described clouds, metres, padded as `descriptors` are."""
        return pack_parts(self.parts, len(self.descriptors.overflow))

    @property
    def occluded(self) -> list[bool]:
        """One flag a row."""
        return [part.occluded for part in self.parts]


class Instance(Protocol):
    """What an answer says of an instance beside its name."""

    @property
    def label(self) -> int: ...  # noqa: D102

    @property
    def kept_by_fallback(self) -> bool: ...  # noqa: D102

    @property
    def reason(self) -> str | None: ...  # noqa: D102


AT_ONCE = 4
"""Instances described and classified at a time: while the device works on them, the next ones are prepared."""

NO_PART = Part(False, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, bool))


def prepare(frame: RGBDFrame, label: int, sigma_s: float) -> tuple[InstanceCloud, Part]:
    """One instance's cloud, and what will be described of it (`NO_PART` if the cloud cannot be used).

    Pure NumPy: it may run in another process, and both results can be pickled.
    """
    cloud = instance_cloud(frame, label)
    if cloud.reason is not None:
        return cloud, NO_PART
    found = find_occlusion(frame, cloud)
    return cloud, Part(found.occluded, *_voxelled(cloud, found.boundary, VOXEL / sigma_s))


def _voxelled(cloud: InstanceCloud, edge: NDArray[np.bool_], size: float) -> tuple[Any, Any, NDArray[np.bool_]]:
    """The cloud on the descriptors' grid (coarser if no bucket holds it), and which voxels hold boundary points."""
    # The mark is a fourth channel; its mean over a voxel is above 0 where one point has it.
    marked = np.column_stack([cloud.colors, edge * np.uint8(255)])
    points, colors = downsample_to_fit(cloud.points, marked, size)
    return points, colors[:, :3], colors[:, 3] > 0


class Recognizer:
    """A trained run, compiled and ready. Functions are compiled once a bucket of points and of instances."""

    def __init__(self, run: TrainedRun, unknown_below: float = 0.0, rule: Rule = DEFAULT_RULE) -> None:
        """Ready to answer with every classifier of `run`.

        Args:
            run: the trained run.
            unknown_below: confidence from 0 to 1 that an answer needs to have a name; an object of no trained class
                tends to get less. A report of `thor2 evaluate` tells which keeps 95 % of the answers.
            rule: how classifiers are joined, see `classifier.join`; the paper's is "larger".

        Raises:
            InputError: a confidence outside 0 to 1, or an unknown rule.
        """
        if rule not in RULES:
            raise InputError(f"rule is {rule!r}; expected one of {', '.join(RULES)}")
        if not 0 <= unknown_below <= 1:
            raise InputError(f"unknown_below is {unknown_below}; it must be from 0 to 1")
        self.run = run
        self.unknown_below = unknown_below
        self.rule: Rule = rule
        self._apply = {name: _compiled(name, model) for name, model in run.classifiers.items()}

    @classmethod
    def load(cls, run_dir: str | Path, unknown_below: float = 0.0, rule: Rule = DEFAULT_RULE) -> "Recognizer":
        """Read a run folder (see `run_folder.load_run`, also for what is raised)."""
        return cls(load_run(run_dir), unknown_below, rule)

    def warm_up(self, max_points: int = 2048, max_instances: int = 16) -> int:
        """Compile everything for frames of up to `max_instances` instances with up to `max_points` points each.

        No such frame compiles anything afterwards. Points are counted on the descriptors' voxel grid (4 mm).

        Returns:
            The number of shapes compiled for.

        Raises:
            InputError: numbers below 1 or past the largest buckets.
        """
        points = [n for n in POINT_BUCKETS if n <= point_bucket(max_points)]
        rows = [b for b in BATCH_BUCKETS if b <= batch_bucket(max_instances)]
        at_once = [b for b in rows if b <= AT_ONCE]
        found = [describe(pack_parts([], b, n), self.run.network, self.run.config) for n in points for b in at_once]
        for b in rows:
            self.probabilities(_together(found[:1], b))
        return len(found) + len(rows)

    def describe(self, frame: RGBDFrame) -> DescribedFrame:
        """Clouds and descriptors of a frame's instances, those past the largest batch bucket included."""
        clouds, parts, found = self._in_turns(frame, self._describe_parts)
        usable = [i for i, cloud in enumerate(clouds) if cloud.reason is None]
        return DescribedFrame(clouds, usable, parts, _together(found, _rows(len(parts))))

    def _in_turns(
        self, frame: RGBDFrame, start: Callable[[Sequence[Part]], T]
    ) -> tuple[list[InstanceCloud], list[Part], list[T]]:
        """Clouds and parts of a frame's instances, and what `start` returns for `AT_ONCE` parts at a time, or fewer.

        The device works on what has been started while the next instances are prepared.
        """
        clouds: list[InstanceCloud] = []
        parts: list[Part] = []
        started: list[T] = []
        for label in frame.instances:
            cloud, part = prepare(frame, label, self.run.config.sigma_s)
            clouds.append(cloud)
            if cloud.reason is None:
                parts.append(part)
                if len(parts) % AT_ONCE == 0:
                    started.append(start(parts[-AT_ONCE:]))
        rest = len(parts) % AT_ONCE
        if rest or not parts:
            started.append(start(parts[len(parts) - rest :]))
        return clouds, parts, started

    def _describe_parts(self, parts: Sequence[Part]) -> Descriptors:
        return describe(pack_parts(parts, _rows(len(parts))), self.run.network, self.run.config)

    def probabilities(
        self, descriptors: Descriptors, names: Sequence[Feature] | None = None
    ) -> dict[Feature, NDArray[np.float32]]:
        """Feature -> [B, C] class probabilities of its classifier; of all classifiers unless `names` picks some."""
        running = {name: self._apply[name](descriptors) for name in (self._apply if names is None else names)}
        return {name: np.asarray(values) for name, values in running.items()}

    def recognize(self, frame: RGBDFrame, classifiers: Sequence[Feature] = THOR2) -> list[Recognition]:
        """Name every instance of a frame, in the order of its label numbers.

        Args:
            frame: color, depth, labels, intrinsics.
            classifiers: those that vote; the paper's two by default.

        Raises:
            InputError: a classifier that the run does not have. An instance that cannot be named is no error: its
                `reason` tells.
        """
        voting = check_features(classifiers, "classifiers")
        missing = [name for name in voting if name not in self._apply]
        if missing:
            raise InputError(f"classifiers: the run has no {', '.join(missing)}, only {', '.join(self._apply)}")

        def start(parts: Sequence[Part]) -> tuple[Any, dict[Feature, Any]]:
            found = self._describe_parts(parts)
            return found.overflow, {name: self._apply[name](found) for name in voting}

        clouds, parts, started = self._in_turns(frame, start)
        overflow, probabilities = _together(started, _rows(len(parts)))
        return self.answers(clouds, parts, probabilities, overflow)

    def answers(
        self,
        instances: Sequence[Instance],
        parts: Sequence[Part],
        probabilities: Mapping[Feature, NDArray[np.float32]],
        overflow: ArrayLike,
    ) -> list[Recognition]:
        """What is said of each instance of a frame.

        Args:
            instances: all of them; those without a reason are in the rows of the other arguments, in order.
            parts: what was described of them.
            probabilities: classifier -> [B, C] class probabilities.
            overflow: [B] int, the descriptors'.
        """
        joined = join(probabilities, self.rule)
        points_past = np.asarray(overflow)
        row_of = iter(range(len(parts)))
        found = []
        for one in instances:
            if one.reason is not None:
                found.append(Recognition(label=one.label, reason=one.reason))
                continue
            row = next(row_of)
            confidence = float(joined.confidence[row])
            unknown = confidence < self.unknown_below
            found.append(
                Recognition(
                    label=one.label,
                    name=None if unknown else self.run.classes[joined.class_index[row]],
                    confidence=confidence,
                    classifier=str(joined.classifier[row]),
                    top={name: self._top(values[row]) for name, values in probabilities.items()},
                    occluded=parts[row].occluded,
                    overflow=int(points_past[row]),
                    points_used=len(parts[row].points),
                    kept_by_fallback=one.kept_by_fallback,
                    reason=f"unknown: a confidence of {confidence:.3f}, below {self.unknown_below:g}"
                    if unknown
                    else None,
                )
            )
        return found

    def _top(self, probabilities: NDArray[np.float32], count: int = 5) -> list[tuple[str, float]]:
        best = np.argsort(-probabilities, kind="stable")[:count]
        return [(self.run.classes[i], float(probabilities[i])) for i in best]


def _rows(n: int) -> int:
    """Rows that `n` instances are padded to: a batch bucket, after as many of the largest as they fill."""
    whole = n // BATCH_BUCKETS[-1] * BATCH_BUCKETS[-1]
    return n if n == whole > 0 else whole + batch_bucket(max(n - whole, 1))


def pack_parts(parts: Sequence[Part], n_rows: int, capacity: int | None = None) -> PointClouds:
    """Parts as clouds, and empty clouds up to `n_rows`, on the host; `capacity` as in `PointClouds.pack`."""
    padded = [*parts, *[NO_PART] * (n_rows - len(parts))]
    clouds = [(part.points, part.colors) for part in padded]
    return PointClouds.pack(clouds, capacity, boundary=[part.boundary for part in padded], on_host=True)


def _together(found: Sequence[T], n_rows: int) -> T:
    """Batches one after the other along the first axis, on the host; zeros up to `n_rows`."""

    def join_rows(*batches: jax.Array) -> NDArray[Any]:
        padding = np.zeros((n_rows - sum(map(len, batches)), *batches[0].shape[1:]), batches[0].dtype)
        return np.concatenate([*batches, padding])

    joined: T = jax.tree.map(join_rows, *found)
    return joined


def _compiled(name: Feature, model: MLP) -> Any:
    graph, state = nnx.split(model)
    # Leaves, since a state would be taken apart, in Python, at every call.
    leaves, structure = jax.tree.flatten(state)

    @jax.jit
    def forward(leaves: list[jax.Array], found: Descriptors) -> jax.Array:
        return class_probabilities(nnx.merge(graph, jax.tree.unflatten(structure, leaves)), found, name)

    return lambda found: forward(leaves, found)
