"""From an RGB-D frame to object names (paper, section "Recognition"): clouds, descriptors, two classifiers, one answer.

>>> recognizer = Recognizer.load("run")                                             # doctest: +SKIP
>>> frame = read_frame(color="c.png", depth="d.png", labels="l.png", intrinsics="k.json")  # doctest: +SKIP
>>> [(r.label, r.name, r.confidence) for r in recognizer.recognize(frame)]          # doctest: +SKIP
[(1, 'mug', 0.98), (2, 'bowl', 0.71)]
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from numpy.typing import NDArray

from thor2_jax.capacity import BATCH_BUCKETS, POINT_BUCKETS, batch_bucket, point_bucket
from thor2_jax.classifier import (
    DEFAULT_RULE,
    MLP,
    RULES,
    Feature,
    Rule,
    check_features,
    class_probabilities,
    join,
)
from thor2_jax.descriptor import describe
from thor2_jax.errors import InputError
from thor2_jax.frames import RGBDFrame
from thor2_jax.instance_clouds import InstanceCloud, instance_cloud
from thor2_jax.occlusion import find_occlusion
from thor2_jax.run_folder import TrainedRun, load_run
from thor2_jax.types import Descriptors, PointClouds
from thor2_jax.voxel_grid import downsample_to_fit

__all__ = ["NO_PART", "THOR2", "VOXEL", "DescribedFrame", "Part", "Recognition", "Recognizer", "prepare"]

THOR2: tuple[Feature, ...] = ("tops", "tops2")
"""The two classifiers whose joint answer is THOR2's."""

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
        usable: indices into `clouds`, one a row of `packed` and `descriptors`.
        parts: what was described, one a row.
        packed: the described clouds, metres, padded to a batch bucket (rows past `usable` are empty).
        descriptors: of `packed`.
    """

    clouds: list[InstanceCloud]
    usable: list[int]
    parts: list[Part]
    packed: PointClouds
    descriptors: Descriptors

    @property
    def occluded(self) -> list[bool]:
        """One flag a row."""
        return [part.occluded for part in self.parts]


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
        batches = [b for b in BATCH_BUCKETS if b <= batch_bucket(max_instances)]
        for n in points:
            for b in batches:
                nothing = PointClouds.pack([(NO_PART.points, NO_PART.colors)] * b, n)
                self.probabilities(describe(nothing, self.run.network, self.run.config))
        return len(points) * len(batches)

    def describe(self, frame: RGBDFrame) -> DescribedFrame:
        """Clouds and descriptors of a frame's instances, those past the largest batch bucket included."""
        prepared = [prepare(frame, label, self.run.config.sigma_s) for label in frame.instances]
        clouds = [cloud for cloud, _ in prepared]
        usable = [i for i, cloud in enumerate(clouds) if cloud.reason is None]
        parts = [prepared[i][1] for i in usable]
        packed, descriptors = self._describe_parts(parts)
        return DescribedFrame(clouds, usable, parts, packed, descriptors)

    def _describe_parts(self, parts: Sequence[Part]) -> tuple[PointClouds, Descriptors]:
        limit = BATCH_BUCKETS[-1]
        capacity = point_bucket(max((len(part.points) for part in parts), default=1))
        batches = []
        for start in range(0, max(len(parts), 1), limit):
            chunk = list(parts[start : start + limit])
            chunk += [NO_PART] * (batch_bucket(max(len(chunk), 1)) - len(chunk))
            clouds = [(part.points, part.colors) for part in chunk]
            packed = PointClouds.pack(clouds, capacity, boundary=[part.boundary for part in chunk])
            batches.append((packed, describe(packed, self.run.network, self.run.config)))
        return jax.tree.map(lambda *arrays: np.concatenate(arrays), *batches) if len(batches) > 1 else batches[0]

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
        described = self.describe(frame)
        found = self.probabilities(described.descriptors, voting)
        rows = {index: row for row, index in enumerate(described.usable)}
        overflow = np.asarray(described.descriptors.overflow)
        return [
            self.name(
                cloud.label,
                described.parts[rows[index]],
                {name: values[rows[index]] for name, values in found.items()},
                int(overflow[rows[index]]),
                cloud.kept_by_fallback,
            )
            if index in rows
            else Recognition(label=cloud.label, reason=cloud.reason)
            for index, cloud in enumerate(described.clouds)
        ]

    def name(
        self,
        label: int,
        part: Part,
        probabilities: Mapping[Feature, NDArray[np.float32]],
        overflow: int,
        kept_by_fallback: bool,
    ) -> Recognition:
        """The answer for one instance that was described.

        Args:
            label: its number in the label image.
            part: what was described of it.
            probabilities: classifier -> [C] class probabilities.
            overflow: the descriptor's.
            kept_by_fallback: as in `InstanceCloud`.
        """
        joined = join({name: values[None] for name, values in probabilities.items()}, self.rule)
        confidence = float(joined.confidence[0])
        unknown = confidence < self.unknown_below
        return Recognition(
            label=label,
            name=None if unknown else self.run.classes[joined.class_index[0]],
            confidence=confidence,
            classifier=str(joined.classifier[0]),
            top={name: self._top(values) for name, values in probabilities.items()},
            occluded=part.occluded,
            overflow=overflow,
            points_used=len(part.points),
            kept_by_fallback=kept_by_fallback,
            reason=f"unknown: a confidence of {confidence:.3f}, below {self.unknown_below:g}" if unknown else None,
        )

    def _top(self, probabilities: NDArray[np.float32], count: int = 5) -> list[tuple[str, float]]:
        best = np.argsort(-probabilities, kind="stable")[:count]
        return [(self.run.classes[i], float(probabilities[i])) for i in best]


def _compiled(name: Feature, model: MLP) -> Any:
    graph, state = nnx.split(model)
    forward = jax.jit(lambda state, found: class_probabilities(nnx.merge(graph, state), found, name))
    return lambda found: forward(state, found)
