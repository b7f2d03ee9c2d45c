"""The tracker, which follows the objects of successive frames and fuses the answers for each object.

>>> tracker = recognizer.track()                                                    # doctest: +SKIP
>>> for frame in frames:                                                            # doctest: +SKIP
...     for answer in tracker.update(frame):
...         print(answer.track, answer.name, answer.confidence)
>>> [(track.track, track.name, track.frames) for track in tracker.tracks()]        # doctest: +SKIP
[(1, 'mug', 5), (2, 'bowl', 4)]

The log-probabilities of each classifier and the scores of the gallery are averaged, with the weights of the views.
Successive frames are nearly the same, so their probabilities are not multiplied like those of independent observations:
if all frames of a track have the same probabilities, the track has the confidence of a single frame.
"""

import dataclasses
import itertools
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Protocol, Self

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import softmax

from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame, check_frame
from thor2_jax.frames.prepared_instance import EMPTY_INSTANCE, PreparedInstance
from thor2_jax.model.inference import Inference, answers, object_scores
from thor2_jax.model.model import Model
from thor2_jax.model.recognition import Recognition, overflow_reason
from thor2_jax.tracking.matching import match, moved
from thor2_jax.tracking.viewpoints import (
    NextView,
    PosedInstance,
    ViewTable,
    check_pose,
    merge_views,
    next_view,
    transform,
)

__all__ = ["FusedEvidence", "TrackedRecognition", "Tracker", "view_weight"]

OCCLUDED_WEIGHT = 0.5
"""Weight of a point of an occluded instance; other points have weight 1."""

HALF_LIFE = 30
"""Number of described clouds (with poses, two for each frame) after which the weight of an older one has halved."""


def view_weight(instance: PreparedInstance) -> float:
    """Return the weight of a view: its number of points, times `OCCLUDED_WEIGHT` if it is occluded."""
    return len(instance.points) * (OCCLUDED_WEIGHT if instance.occluded else 1.0)


def _log_with_rest(probabilities: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the logarithms [C + 1] of probabilities [C] and of the rest to 1."""
    rest = 1 - float(probabilities.sum(dtype=np.float64))
    return np.log(np.maximum(np.append(probabilities.astype(np.float64), rest), np.finfo(np.float32).tiny))


class _Means:
    """Weighted means of named values over the views of an object, where old views lose weight.

    The means start again with the first view that has values of other names.
    """

    def __init__(self) -> None:
        self._weight = 0.0
        self._sums: dict[str, Any] = {}

    def add(self, weight: float, values: Mapping[str, Any]) -> None:
        decay = 0.5 ** (1 / HALF_LIFE)
        if self._sums.keys() != values.keys():
            self._weight, self._sums = 0.0, dict.fromkeys(values, 0.0)
        self._weight = decay * self._weight + weight
        self._sums = {name: decay * self._sums[name] + weight * value for name, value in values.items()}

    def values(self) -> dict[str, Any]:
        return {name: total / max(self._weight, np.finfo(np.float64).tiny) for name, total in self._sums.items()}


class FusedEvidence:
    """The fused inferences of the views of one object: means of log-probabilities, and of scores of the gallery."""

    def __init__(self) -> None:
        self._logs, self._scores = _Means(), _Means()
        self._has_gallery = False

    def add(
        self, weight: float, probabilities: Mapping[str, NDArray[np.floating]], scores: Mapping[str, float] | None
    ) -> None:
        """Add a view.

        Args:
            weight: weight of the view, see `view_weight`.
            probabilities: classifier -> class probabilities [C], which may sum to less than 1. If other classifiers
                answer than for the last view, their means start again.
            scores: object -> score of the gallery. If objects were enrolled or forgotten since the last view, the means
                of the scores start again. None if the classifiers alone answer.
        """
        self._logs.add(weight, {name: _log_with_rest(p) for name, p in probabilities.items()})
        self._scores.add(weight, scores or {})
        self._has_gallery = scores is not None

    def fused(self) -> tuple[dict[str, NDArray[np.float64]], dict[str, float] | None]:
        """Return classifier -> fused class probabilities [C], and object -> fused score; None without a gallery."""
        probabilities = {name: softmax(logs)[:-1] for name, logs in self._logs.values().items()}
        return probabilities, self._scores.values() if self._has_gallery else None


MAX_MISSED = 10
"""Number of frames without a view of an object after which its track ends."""

MERGED_VIEWS = 6
"""Number of latest views of an object whose clouds are merged; they suffice to see it from all sides."""


@dataclasses.dataclass(frozen=True)
class TrackedRecognition(Recognition):
    """The answer for one instance of a frame, fused over the frames of its track.

    Attributes:
        track: number of the track, from 1; None if the instance could not be described.
        frames: number of frames so far in which the object was visible.
    """

    track: int | None = None
    frames: int = 0

    def renamed(self, other: Self) -> Self:
        """Return this answer with the name, the confidence and the number of frames of another answer of the track."""
        changed = ("name", "confidence", "classifier", "top", "reason", "frames")
        return dataclasses.replace(self, **{name: getattr(other, name) for name in changed})


class _Track:
    """A tracked object.

    Attributes:
        number: number of the track from 1, in the order of appearance.
        points: cloud [n, 3] of the last view, in the coordinates of the last frame or, with poses, of the world.
        instance: the last described cloud, which is the last view, merged with earlier views if there are poses.
        overflow: number of points of that cloud outside the descriptor's grid.
        seen: number of the frame of the last view.
        views: the latest views and the poses of their cameras; empty without poses.
        frames: number of views.
        evidence: fused inferences of the views.
    """

    def __init__(self, number: int) -> None:
        self.number, self.frames, self.seen, self.overflow = number, 0, 0, 0
        self.points: NDArray[np.floating] = np.zeros((0, 3))
        self.instance = EMPTY_INSTANCE
        self.views: deque[PosedInstance] = deque(maxlen=MERGED_VIEWS)
        self.evidence = FusedEvidence()


class FrameInference(Protocol):
    """The part of a `Recognizer` that a tracker uses."""

    @property
    def model(self) -> Model: ...
    def prepare(self, frame: RGBDFrame) -> Iterable[PreparedInstance]: ...
    def infer(self, instances: Iterable[PreparedInstance]) -> tuple[list[PreparedInstance], Inference]: ...


class Tracker:
    """The objects of a sequence of frames of one camera.

    Without poses, clouds are compared in camera coordinates (`thor2_jax.tracking.matching`): the camera may move by
    about two centimetres between frames, or by about twelve if it sees several objects. With poses, each view of an
    object is described twice: alone, and merged with the earlier views.
    """

    def __init__(self, recognizer: FrameInference) -> None:
        """Create a tracker without tracks, as `Recognizer.track` does."""
        self._recognizer = recognizer
        self._tracks: list[_Track] = []
        self._frame = 0
        self._size: tuple[int, ...] = ()
        self._has_poses = False
        self._numbers = itertools.count(1)

    def update(self, frame: RGBDFrame, pose: ArrayLike | None = None) -> list[TrackedRecognition]:
        """Recognize the next frame and return its answers, fused with earlier frames, in the order of the labels.

        Args:
            frame: a frame of the same size as the first one.
            pose: [4, 4] the camera's pose, see `check_pose`; give it for all frames or for none.

        Raises:
            InputError: the frame has another size than the first one, the pose is not a rigid motion, or only one of
                this frame and the first frame has a pose. The tracks do not change.
        """
        check_frame(frame)
        world = None if pose is None else check_pose(pose)
        if self._frame and frame.depth.shape != self._size:
            (height, width), (rows, columns) = frame.depth.shape, self._size
            raise InputError(
                f"frame has {width} x {height} pixels; expected {columns} x {rows}, as the first frame of the tracker; "
                "track the frames of another camera apart"
            )
        if self._frame and (world is not None) != self._has_poses:
            given, expected = ("given", "none") if world is not None else ("None", "a pose")
            raise InputError(f"pose is {given}; expected {expected}, as for the first frame: give all poses or none")
        instances, inference = self._recognizer.infer(self._recognizer.prepare(frame))
        self._size, self._has_poses = frame.depth.shape, world is not None
        self._frame += 1
        self._tracks = [track for track in self._tracks if self._frame - track.seen <= MAX_MISSED]
        usable = [instance for instance in instances if instance.reason is None]
        answers = iter(self._answers(self._extend(usable, inference, world)))
        return [
            next(answers) if instance.reason is None else TrackedRecognition(instance.label, reason=instance.reason)
            for instance in instances
        ]

    def tracks(self) -> list[TrackedRecognition]:
        """Return the answers for all tracked objects, with the labels of their last views."""
        return self._answers(self._tracks)

    def next_view(self, track: int, candidates: Sequence[ArrayLike], table: ViewTable) -> NextView:
        """Return the camera pose whose view of an object is expected to make its name most certain.

        Args:
            track: number of the object's track.
            candidates: poses [4, 4] that the camera can reach and from which it sees the object.
            table: training views of the classes.

        Raises:
            InputError: there is no such track, the frames had no poses, or no classifier answers; also as `next_view`.
        """
        followed = {each.number: each for each in self._tracks}.get(track)
        if followed is None:
            numbers = ", ".join(str(each.number) for each in self._tracks) or "none"
            raise InputError(f"track is {track!r}; expected one of {numbers}")
        probabilities, _ = followed.evidence.fused()
        if not followed.views or not probabilities:
            missing = "answers of classifiers" if followed.views else "poses"
            raise InputError(f"track {track} has no {missing}; next_view needs them")
        fused = self._recognizer.model.fused({name: p[None].astype(np.float32) for name, p in probabilities.items()})[0]
        pose, points = followed.views[-1][1], followed.instance.points
        centre = (points.min(axis=0, keepdims=True) + points.max(axis=0, keepdims=True)) / 2
        return next_view(fused, transform(pose, centre)[0], pose, candidates, table)

    def _extend(
        self, usable: Sequence[PreparedInstance], inference: Inference, world: NDArray[np.float64] | None
    ) -> list[_Track]:
        """Add every instance to its track, or start a new track; return the track of each instance."""
        points = [each.points if world is None else transform(world, each.points) for each in usable]
        pairs, motion = match([track.points for track in self._tracks], points, is_moving=world is None)
        matched = {j: self._tracks[i] for i, j in pairs}
        for track in self._tracks:  # an object that is seen again later has moved like the others
            track.points = moved(track.points, -motion)
        tracks = [matched.get(row) or _Track(next(self._numbers)) for row in range(len(usable))]
        self._tracks += [track for track in tracks if not track.frames]
        for track, instance, cloud in zip(tracks, usable, points, strict=True):
            track.points, track.instance = cloud, instance
            track.seen, track.frames = self._frame, track.frames + 1
            if world is not None:
                track.views.append((instance, world))
        self._add_evidence(tracks, inference)
        several = [track for track in tracks if len(track.views) > 1]
        for track in several:
            track.instance = merge_views(track.views, self._recognizer.model.run.config.sigma_s)
        if several:
            self._add_evidence(several, self._recognizer.infer(track.instance for track in several)[1])
        return tracks

    def _add_evidence(self, tracks: Sequence[_Track], inference: Inference) -> None:
        """Add each row of an inference to its track, weighted by the described cloud."""
        model = self._recognizer.model
        inference = jax.tree.map(lambda a: np.asarray(a)[: len(tracks)], inference)
        scores = object_scores(model, inference)
        for row, track in enumerate(tracks):
            track.overflow = int(inference.overflow[row])
            weight = 0.0 if overflow_reason(track.overflow, len(track.instance.points)) else view_weight(track.instance)
            probabilities = {name: values[row] for name, values in inference.probabilities.items()}
            by_name = None if scores is None else dict(zip(model.gallery.names, scores[row].tolist(), strict=True))
            track.evidence.add(weight, probabilities, by_name)

    def _answers(self, tracks: Sequence[_Track]) -> list[TrackedRecognition]:
        model = self._recognizer.model
        answered = []
        for track in tracks:  # one by one: tracks without a recent view may have the outputs of other classifiers
            fused, by_name = track.evidence.fused()
            probabilities = {name: p[None] for name, p in fused.items()}
            scores = None if by_name is None else np.array([[by_name.get(name, 0.0) for name in model.gallery.names]])
            inference = Inference(np.array([track.overflow]), probabilities, scores=scores)
            (answer,) = answers(model, [track.instance], inference)
            answered.append(TrackedRecognition(**vars(answer), track=track.number, frames=track.frames))
        return answered
