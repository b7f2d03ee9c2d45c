"""Trackers with a toy recognizer that reads an instance's probabilities from its colour."""

import dataclasses
import functools
from collections.abc import Iterable

import numpy as np
import pytest
from image_files import frame_of_squares
from refusals import assert_refused
from small_runs import assert_same_answers, small_embedding, untrained_run

from thor2_jax.frames.prepared_instance import PreparedInstance
from thor2_jax.model.inference import Inference
from thor2_jax.recognizer import Recognizer
from thor2_jax.tracking.tracker import FusedEvidence, Tracker, view_weight
from thor2_jax.tracking.viewpoints import ViewTable
from training.rendering.camera import camera_pose

run = functools.cache(lambda: untrained_run(("a", "b", "c"), ("tops", "tops2"), seed=1))


class ToyRecognizer(Recognizer):
    """Answers by the mean colour of an instance, whose channels are class probabilities in 1/255."""

    overflow = 0

    def __init__(self) -> None:
        super().__init__(run())
        self.described: list[PreparedInstance] = []

    def infer(self, instances: Iterable[PreparedInstance]) -> tuple[list[PreparedInstance], Inference]:
        given = list(instances)
        usable = [each for each in given if each.reason is None]
        self.described += usable
        p = np.array([each.colors.mean(axis=0) / 255 for each in usable])
        return given, Inference(np.full(len(p), self.overflow), {"tops": p, "tops2": p})


SURE_A, UNSURE_B = (230, 15, 10), (100, 125, 30)
TWO = frame_of_squares({1: (10, 10, SURE_A), 2: (60, 100, UNSURE_B)})
TWO = dataclasses.replace(TWO, color=np.random.default_rng(0).integers(0, 256, TWO.color.shape, np.uint8))
"""A frame of two instances in random colours."""


def test_a_track_keeps_its_number_and_fuses_the_answers() -> None:
    tracker = Tracker(ToyRecognizer())
    first = tracker.update(frame_of_squares({1: (10, 10, SURE_A), 2: (60, 100, (10, 10, 235))}))
    second = tracker.update(frame_of_squares({7: (62, 98, (10, 10, 235)), 9: (12, 12, UNSURE_B)}))
    assert [(r.label, r.track, r.name, r.frames) for r in first] == [(1, 1, "a", 1), (2, 2, "c", 1)]
    assert [(r.label, r.track, r.name, r.frames) for r in second] == [(7, 2, "c", 2), (9, 1, "a", 2)]
    assert [track.name for track in tracker.tracks()] == ["a", "c"]


def test_a_view_of_fewer_points_has_a_smaller_weight() -> None:
    recognizer = ToyRecognizer()
    tracker, part = Tracker(recognizer), frame_of_squares({1: (10, 10, UNSURE_B)})
    labels = np.where(np.arange(part.depth.shape[1]) < 24, part.label_image, 0)
    tracker.update(frame_of_squares({1: (10, 10, SURE_A)}))
    (answer,) = tracker.update(dataclasses.replace(part, labels=labels))
    first, second = (len(each.points) * (0.5 if each.occluded else 1) for each in recognizer.described)
    first *= 0.5 ** (1 / 30)  # a view loses half of its weight in 30 further ones
    mean = np.exp(np.average(np.log([SURE_A, UNSURE_B]), axis=0, weights=[first, second]))
    assert second < first / 2 and answer.confidence == pytest.approx(mean[0] / mean.sum(), abs=1e-4)
    recognizer.overflow = round(0.6 * len(recognizer.described[0].points))  # such a view does not count
    for each, confidence in (tracker, answer.confidence), (Tracker(recognizer), 1 / 3):
        (overflowed,) = each.update(frame_of_squares({1: (10, 10, UNSURE_B)}))
        assert (overflowed.name, overflowed.confidence) == (None, pytest.approx(confidence))
    whole, hidden = (dataclasses.replace(recognizer.described[0], occluded=occluded) for occluded in (False, True))
    assert view_weight(hidden) == view_weight(whole) / 2


@pytest.mark.parametrize("is_taught", [False, True])
def test_the_first_answer_is_that_of_the_frame_alone(is_taught: bool) -> None:
    recognizer = Recognizer(run(), embedding=small_embedding())
    if is_taught:
        recognizer.enroll("mug", [(TWO, 1)])
    tracker = recognizer.track()
    alone, tracked = recognizer.recognize(TWO), tracker.update(TWO, np.eye(4))
    again = tracker.update(TWO, np.eye(4))  # merged with an equal cloud
    for answers in (tracked, again):
        assert_same_answers(answers, alone, 1e-3)


@pytest.mark.parametrize("answer_by", ["both", "gallery"])
def test_tracks_answer_as_their_last_views_after_enrolling(answer_by: str) -> None:
    recognizer = Recognizer(run(), embedding=small_embedding(), answer_by=answer_by)
    tracker = recognizer.track()
    first, _ = tracker.update(TWO)
    recognizer.enroll("mug", [(TWO, 2)])
    (second,) = tracker.update(dataclasses.replace(TWO, labels=np.where(TWO.label_image == 2, 2, 0)))
    earlier, later = tracker.tracks()
    assert "gallery" in second.top and later == second and earlier.confidence == first.confidence


def test_poses_match_objects_of_a_camera_that_moved() -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.09  # 77 pixels at a depth of 0.7 m
    boxes = frame_of_squares({1: (10, 110, SURE_A)}), frame_of_squares({1: (10, 33, SURE_A)})
    on_map = np.eye(4)
    on_map[:3, 3] = 500_000, 4_000_000, 100
    with_poses, without, far = (Tracker(ToyRecognizer()) for _ in range(3))
    assert [with_poses.update(f, p)[0].track for f, p in zip(boxes, (np.eye(4), moved), strict=True)] == [1, 1]
    assert [without.update(f)[0].track for f in boxes] == [1, 2]
    below = frame_of_squares({1: (10, 60, SURE_A)}), frame_of_squares({1: (70, 60, SURE_A)})
    assert [far.update(f, on_map)[0].track for f in below] == [1, 2]


def test_poses_distinguish_equal_objects_in_a_row() -> None:
    """The camera moves along the row by twice their distance, so that all images are equal."""
    tracker = Tracker(ToyRecognizer())
    for first in (0, 2, 4):
        pose = np.eye(4)
        pose[0, 3] = 0.07 * first  # 60 pixels at a depth of 0.7 m
        seen = {first + k + 1: (40, 60 * k + 5, SURE_A) for k in range(3)}
        answers = tracker.update(frame_of_squares(seen, 30, (120, 200)), pose)
        assert [(answer.label, answer.track) for answer in answers] == [(k, k) for k in seen]


def test_several_objects_are_followed_while_the_camera_moves() -> None:
    tracker = Tracker(ToyRecognizer())
    for column, labels in ((0, (1, 2, 3)), (48, (1, 3)), (96, (1, 2, 3))):  # 48 pixels are 56 mm
        squares = {k: (40 * k - 35, column + 8 * k, SURE_A) for k in labels}
        answers = tracker.update(frame_of_squares(squares, 30))
        assert [(answer.label, answer.track) for answer in answers] == [(k, k) for k in labels]


def test_views_with_poses_are_described_as_one_cloud() -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.02
    recognizer = ToyRecognizer()
    tracker = Tracker(recognizer)
    tracker.update(frame_of_squares({1: (10, 60, SURE_A)}), np.eye(4))
    (answer,) = tracker.update(frame_of_squares({1: (10, 60, UNSURE_B)}), moved)  # it now lies 2 cm further right
    first, second, both = recognizer.described
    assert np.ptp(second.points[:, 0]) == pytest.approx(np.ptp(first.points[:, 0]), abs=1e-6)
    assert np.ptp(both.points[:, 0]) == pytest.approx(np.ptp(first.points[:, 0]) + 0.02, abs=0.004)
    assert both.points[:, 0].max() == pytest.approx(second.points[:, 0].max(), abs=0.004)
    assert answer.points_used == len(both.points) > len(first.points)
    assert not both.boundary.any() and answer.frames == 2
    for moved[0, 3] in (0.04, 0.06, 0.08, 0.1, 0.12, 0.14):
        tracker.update(frame_of_squares({1: (10, 60, UNSURE_B)}), moved)
    assert np.ptp(recognizer.described[-1].points[:, 0]) == pytest.approx(np.ptp(first.points[:, 0]) + 0.1, abs=0.004)


def test_a_track_ends_when_its_object_is_gone() -> None:
    tracker = Tracker(ToyRecognizer())
    empty, full = frame_of_squares({}), frame_of_squares({1: (10, 10, SURE_A)})
    assert tracker.update(empty) == [] and tracker.tracks() == []
    for n_missed, number in ((0, 1), (9, 1), (10, 2)):
        for _ in range(n_missed):
            tracker.update(empty)
        assert tracker.update(full)[0].track == number
    (unusable,) = tracker.update(frame_of_squares({3: (5, 5, SURE_A)}, 3))
    assert (unusable.label, unusable.track, unusable.name) == (3, None, None) and unusable.reason


def test_frames_and_poses_of_different_sequences_are_refused() -> None:
    tracker = Tracker(ToyRecognizer())
    image = frame_of_squares({1: (10, 10, SURE_A)})
    tracker.update(image)
    assert_refused("160 x 100 pixels; expected 160 x 120", tracker.update, frame_of_squares({}, shape=(100, 160)))
    assert_refused("pose is given", tracker.update, image, np.eye(4))
    assert_refused("rigid", tracker.update, image, 2 * np.eye(4))
    assert tracker.update(image)[0].frames == 2


def test_the_next_view_is_chosen_for_a_track() -> None:
    cameras = [camera_pose(azimuth, np.pi / 2, np.full(3, 5.0), 0.7) for azimuth in (0.0, 2.0, 4.0)]
    doubt, sure = np.array([0.48, 0.48, 0.04]), np.array([0.98, 0.01, 0.01])
    table = ViewTable(np.zeros(3, int), np.stack(cameras)[:, :3, :3], np.stack([doubt, [0.05, 0.05, 0.9], sure]))
    tracker = Tracker(ToyRecognizer())
    for pose in (cameras[0] @ np.diag([-1, -1, 1, 1]), cameras[0]):  # turned about the line of sight
        tracker.update(frame_of_squares({1: (40, 60, (122, 122, 10))}), pose)
    assert tracker.next_view(1, cameras[1:], table).index == 1
    assert_refused("track is 7; expected one of 1", tracker.next_view, 7, cameras, table)
    without = Tracker(ToyRecognizer())
    without.update(frame_of_squares({1: (40, 60, UNSURE_B)}))
    assert_refused("no poses", without.next_view, 1, cameras, table)


def test_fused_evidence_is_a_weighted_mean() -> None:
    evidence = FusedEvidence()
    views = np.array([[0.5, 0.3], [1e-6, 0.6]])  # what is missing to 1 belongs to no class
    evidence.add(3.0, {"embedding": views[0]}, {"mug": 0.9})
    evidence.add(1.0, {"embedding": views[1]}, {"mug": 0.1})
    probabilities, scores = evidence.fused()
    decayed = 3 * 0.5 ** (1 / 30)
    logs = np.log(np.column_stack([views, 1 - views.sum(axis=1)]))
    expected = np.exp((decayed * logs[0] + logs[1]) / (decayed + 1))
    np.testing.assert_allclose(probabilities["embedding"], (expected / expected.sum())[:2], rtol=1e-9)
    assert scores == {"mug": pytest.approx((decayed * 0.9 + 0.1) / (decayed + 1))}
    evidence.add(1.0, {"embedding": views[1]}, {"mug": 0.2, "bowl": 0.7})  # an object was enrolled
    assert evidence.fused()[1] == pytest.approx({"mug": 0.2, "bowl": 0.7})
    evidence.add(1.0, {}, {"mug": 0.2})  # the gallery alone answers
    evidence.add(1.0, {"embedding": views[1]}, None)
    probabilities, scores = evidence.fused()
    np.testing.assert_allclose(probabilities["embedding"], views[1])
    assert scores is None
