"""Placements of made-up videos, against numbers by hand; those of the shared tuning frames against their poses."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import ToyDescriptors, UntaughtRecognizer

import thor2_jax as thor2
from training.evaluation.answering import answer_frames
from training.evaluation.answers import FrameAnswers, InstancePrediction
from training.evaluation.runs import Run
from training.evaluation.scores import find_placements, placement_accuracy, steadiness
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame

SHARED = Path(__file__).parents[4] / "shared" / "data" / "frames"

Objects = dict[int, tuple[str, tuple[float, float, float] | None]]


def video(frames: list[Objects], sequence: str = "a") -> list[FrameAnswers]:
    """Return frames of label -> name and position."""
    return [
        FrameAnswers(
            f"{sequence}/{k}",
            {},
            1.0,
            [InstancePrediction(label, name, position=place) for label, (name, place) in objects.items()],
        )
        for k, objects in enumerate(frames)
    ]


def numbers(frames: list[FrameAnswers]) -> list[list[int]]:
    return [own.tolist() for own in find_placements(frames)]


def test_an_unmoved_object_is_one_placement() -> None:
    """The camera moves by 2 cm a frame; the position of the first frame does not matter in the third."""
    still: list[Objects] = [
        {1: ("mug", (0.02 * k, 0, 1)), 2: ("can", (0.3, 0.02 * k, 1))} for k in range(3)
    ]  # fmt: skip
    assert numbers(video(still)) == [[0, 1]] * 3
    assert numbers(video(still[:2]) + video(still[2:], "b")) == [[0, 1], [0, 1], [2, 3]]
    assert numbers([]) == []


def test_objects_of_one_name_are_matched_by_position() -> None:
    """The label numbers are exchanged; the nearer pair wins where both are near."""
    frames: list[Objects] = [
        {1: ("orange", (0, 0, 1)), 2: ("orange", (0.02, 0, 1))},
        {1: ("orange", (0.021, 0, 1)), 2: ("orange", (0.001, 0, 1))},
    ]
    assert numbers(video(frames)) == [[0, 1], [1, 0]]


@pytest.mark.parametrize(("n_unmoved", "expected"), [(4, [0, 1, 2, 3]), (3, [0, 1, 2, 4]), (2, [4, 5, 6, 7])])
def test_a_new_arrangement_has_new_placements(n_unmoved: int, expected: list[int]) -> None:
    """With two of four objects moved, the others were put back near their place."""
    before: Objects = {k: (f"object {k}", (0.1 * k, 0, 1)) for k in range(4)}
    after: Objects = {k: (f"object {k}", (0.1 * k, 0 if k < n_unmoved else 0.2, 1)) for k in range(4)}
    assert numbers(video([before, after])) == [[0, 1, 2, 3], expected]


def test_instances_without_position_or_renamed_start_anew() -> None:
    frames: list[Objects] = [
        {k: (f"object {k}", (0.1 * k, 0, 1)) for k in range(4)},
        {0: ("object 0", None), **{k: (f"object {k}", (0.1 * k, 0, 1)) for k in range(1, 4)}},
        {k: (f"object {k}" if k else "new", (0.1 * k, 0, 1)) for k in range(4)},
    ]
    assert numbers(video(frames)) == [[0, 1, 2, 3], [4, 1, 2, 3], [5, 1, 2, 3]]


def test_accuracy_and_steadiness_by_hand() -> None:
    """Placement 7 has one of four correct, 9 is all correct; its two answers of three agree, so do three of four."""
    placement, correct = [7, 9, 7, 9, 7, 9, 7, 4], [1, 1, 0, 1, 0, 1, 0, 0]
    assert placement_accuracy(placement, correct) == pytest.approx((0.25 + 1 + 0) / 3)
    answers = [3, 0, 2, 0, 2, 1, 2, 5]
    assert steadiness(placement, answers) == pytest.approx((3 + 2) / (4 + 3))
    assert math.isnan(steadiness([1, 2], [0, 0])) and math.isnan(steadiness([], []))
    assert math.isnan(placement_accuracy([], []))


class Unable(UntaughtRecognizer):
    """Describes nothing, so that only positions are computed."""

    def describe(self, frame: Any) -> Any:
        return SimpleNamespace(instances=[], usable=[], oriented=ToyDescriptors(None))

    def probabilities(self, oriented: Any) -> dict[str, np.ndarray]:
        return {"tops": np.zeros((0, 1), np.float32)}


UNABLE = [Run("run", "", Unable(["mug"]))]  # type: ignore[arg-type]


def test_position_is_the_median_of_the_points() -> None:
    """Two pixels at 2 m and one at 9 m, which belongs to the background; one without depth does not count."""
    depth = np.zeros((3, 5), np.uint16)
    depth[1, 1:4] = 2000, 2000, 9000
    labels = np.zeros((3, 5), np.uint8)
    labels[1] = [0, 1, 1, 1, 1]
    labels[2, 0] = 2
    frame = thor2.RGBDFrame(np.zeros((3, 5, 3), np.uint8), depth, labels, thor2.Intrinsics(10.0, 10.0, 0.0, 0.0))
    ((_, answers),) = answer_frames(UNABLE, [LabelledFrame("f", frame, {1: "mug", 2: "mug", 3: "mug"}, {})])
    assert [instance.position for instance in answers.instances] == [(0.4, 0.2, 2.0), None, None]


@pytest.mark.parametrize(
    ("source", "n_frames", "n_placements"),
    [("ycbv_real_0000", 3, 3), ("ycbv_real_0001", 3, 4), ("ycbv_posecnn_demo", 5, 20)],
)
def test_placements_of_shared_frames(source: str, n_frames: int, n_placements: int) -> None:
    """The numbers of objects in the scenes; poses, where the labels have them, agree that nothing moves."""
    if not SHARED.is_dir():
        pytest.skip(f"no {SHARED}")
    dataset = FrameFolder(SHARED / source)
    frames = [answers for _, answers in answer_frames(UNABLE, [dataset[k] for k in range(n_frames)])]
    placements = find_placements(frames)
    assert len(np.unique(np.concatenate(placements))) == n_placements
    if source == "ycbv_real_0001":
        poses = [
            json.loads((SHARED / source / name / "labels.json").read_text())["poses"] for name in ("000001", "000002")
        ]
        moves = [np.linalg.norm(np.array(poses[0][k])[:, 3] - np.array(poses[1][k])[:, 3]) for k in poses[0]]
        assert max(moves) < 0.01 and placements[0].tolist() == placements[1].tolist()
