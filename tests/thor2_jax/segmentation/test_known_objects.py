"""Pieces that are divided and merged by recognition: toy answers by the overlap with true masks."""

import dataclasses
from collections.abc import Callable, Sequence
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import KDTree
from segmentation_scenes import Box, best_overlaps, render

from thor2_jax.frames.frames import RGBDFrame, backproject
from thor2_jax.segmentation.known_objects import Answer, Distances, Recognize, fit_masks, segment_known
from thor2_jax.segmentation.pixels import grow, shrink

RED, BLUE = (200, 40, 40), (40, 40, 200)
FRAME = render(
    [Box(-0.04, 0, (0.04, 0.05), 0.06, RED), Box(0.03, 0, (0.03, 0.05), 0.06, BLUE)], tilt=30, size=(480, 640)
)
TRUTH = np.asarray(FRAME.labels, np.int32)
ONE_PIECE = (TRUTH > 0).astype(np.int32)


def knows(*objects: NDArray[np.bool_], frame: RGBDFrame = FRAME) -> Recognize:
    """Return a recognizer of objects, given their masks, whose confidence is the overlap with the best one."""

    def answer(shown: RGBDFrame) -> Answer:
        top, left = round(frame.intrinsics.cy - shown.intrinsics.cy), round(frame.intrinsics.cx - shown.intrinsics.cx)
        mask = np.zeros(frame.depth.shape, bool)
        height, width = shown.depth.shape
        mask[top : top + height, left : left + width] = shown.label_image == 1
        overlaps = [(mask & each).sum() / (mask | each).sum() for each in objects]
        return str(np.argmax(overlaps)), float(max(overlaps))

    return lambda frames: [answer(shown) for shown in frames]


def always(name: str | None, confidence: float) -> Recognize:
    """Return a recognizer that gives one answer for everything."""
    return lambda frames: [(name, confidence)] * len(frames)


def same_name(frames: Sequence[RGBDFrame]) -> list[Answer]:
    """Know both objects by one name."""
    return [("a", confidence) for _, confidence in knows(TRUTH == 1, TRUTH == 2)(frames)]


def assert_divided(labels: NDArray[np.int32], least: float) -> None:
    """Assert that the piece is divided into the two objects, with at least some overlap each."""
    assert labels.max() == 2 and (best_overlaps(labels, TRUTH) > least).all()
    np.testing.assert_array_equal(labels > 0, ONE_PIECE > 0)


def nowhere(frame: RGBDFrame) -> dict[int, Distances]:
    """Locate no object."""
    return {}


def test_a_piece_with_two_known_objects_is_divided() -> None:
    assert_divided(segment_known(FRAME, ONE_PIECE, knows(TRUTH == 1, TRUTH == 2), nowhere), 0.9)


def test_only_pieces_of_one_known_object_are_merged() -> None:
    quantiles = np.quantile(np.nonzero(TRUTH)[1], [0.45, 0.9])
    three = np.where(TRUTH > 0, 1 + np.digitize(np.arange(640), quantiles), 0)
    for pieces in (TRUTH, three):
        np.testing.assert_array_equal(segment_known(FRAME, pieces, knows(TRUTH > 0), nowhere), ONE_PIECE)
    large = np.where(TRUTH > 0, TRUTH + (2**31 - 3), 0).astype(np.int32)
    for labels in (TRUTH, large):
        np.testing.assert_array_equal(segment_known(FRAME, labels, knows(TRUTH == 1, TRUTH == 2), nowhere), TRUTH)


def test_a_large_image_is_divided_at_a_lower_resolution() -> None:
    small = FRAME.intrinsics
    camera = dataclasses.replace(small, fx=2 * small.fx, fy=2 * small.fy, cx=2 * small.cx, cy=2 * small.cy)
    color, depth, piece = (each.repeat(2, 0).repeat(2, 1) for each in (FRAME.color, FRAME.depth, ONE_PIECE))
    recognize = knows(TRUTH == 1, TRUTH == 2)
    labels = segment_known(RGBDFrame(color, depth, None, camera), piece, recognize, nowhere)
    np.testing.assert_array_equal(labels[::2, ::2], segment_known(FRAME, ONE_PIECE, recognize, nowhere))
    np.testing.assert_array_equal(labels > 0, piece > 0)


def test_frames_without_pieces_or_without_depth_remain() -> None:
    assert not segment_known(FRAME, np.zeros_like(TRUTH), always(None, 0.0), nowhere).any()
    frame = RGBDFrame(FRAME.color, np.zeros_like(FRAME.depth), None, FRAME.intrinsics)
    np.testing.assert_array_equal(segment_known(frame, ONE_PIECE, always(None, 0.0), nowhere), ONE_PIECE)


CONSTANT = (always(None, 0.99), always("a", 0.5), always("a", 0.99))


@pytest.mark.parametrize("recognize", [knows(TRUTH > 0), knows(TRUTH == 1), *CONSTANT, same_name])
def test_a_piece_with_one_known_object_or_one_name_remains(recognize: Recognize) -> None:
    np.testing.assert_array_equal(segment_known(FRAME, ONE_PIECE, recognize, nowhere), ONE_PIECE)


def test_candidates_are_shown_where_they_are() -> None:
    recognize = Mock(side_effect=always(None, 0.0))
    segment_known(FRAME, TRUTH, recognize, nowhere)
    shown = [frame for call in recognize.call_args_list for frame in call.args[0]]
    points = backproject(FRAME.depth_m, FRAME.intrinsics)[TRUTH == 1]
    whole = [frame for frame in shown if (frame.label_image == 1).sum() == len(points)]
    assert whole and all((frame.label_image > 1).any() for frame in whole)
    seen = backproject(whole[0].depth_m, whole[0].intrinsics)[whole[0].label_image == 1]
    np.testing.assert_allclose(seen, points, atol=1e-5)


def surface_of(mask: NDArray[np.bool_]) -> Distances:
    """Return the distances from the points of a true mask."""
    tree = KDTree(backproject(FRAME.depth_m, FRAME.intrinsics)[mask & (FRAME.depth_m > 0)])
    return lambda points: np.asarray(tree.query(points)[0])


def located(*masks: NDArray[np.bool_]) -> Callable[[RGBDFrame], dict[int, Distances]]:
    """Return a function that locates the object with the largest overlap; distances are ten times too large."""
    surfaces = [surface_of(mask) for mask in masks]

    def locate(frame: RGBDFrame) -> dict[int, Distances]:
        best = {n: np.argmax([(mask & (frame.labels == n)).sum() for mask in masks]) for n in frame.instances}
        return {n: lambda points, surface=surfaces[k]: 10 * surface(points) for n, k in best.items()}

    return locate


def test_pixels_of_other_surfaces_are_left_for_the_next_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a piece resembles an object at first; without surfaces, the piece remains."""
    monkeypatch.setattr("thor2_jax.segmentation.known_objects.ROUNDS", 0)
    masks = TRUTH == 1, TRUTH == 2
    alike = knows(*masks)

    def recognize(frames: Sequence[RGBDFrame]) -> list[Answer]:
        are_whole = [(frame.label_image == 1).sum() == ONE_PIECE.sum() for frame in frames]
        return [("0", 0.985) if whole else each for whole, each in zip(are_whole, alike(frames), strict=True)]

    labels = segment_known(FRAME, ONE_PIECE, recognize, located(*masks))
    assert_divided(labels, 0.98)
    np.testing.assert_array_equal(segment_known(FRAME, ONE_PIECE, recognize, nowhere), ONE_PIECE)


def test_an_object_gets_all_pixels_on_its_surface(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the upper half of one object is known."""
    monkeypatch.setattr("thor2_jax.segmentation.known_objects.ROUNDS", 0)
    middle = np.median(np.nonzero(TRUTH == 1)[0])
    upper = (TRUTH == 1) & (np.arange(480)[:, None] < middle)
    recognize = knows(upper, TRUTH == 2)
    labels = segment_known(FRAME, ONE_PIECE, recognize, located(TRUTH == 1, TRUTH == 2))
    assert_divided(labels, 0.98)


@pytest.mark.parametrize("seen", [0, 3])
def test_a_surface_with_few_of_the_points_changes_no_mask(seen: int) -> None:
    recognize = Mock(side_effect=always("0", 0.985))

    def locate(frame: RGBDFrame) -> dict[int, Distances]:
        return {1: lambda points: np.where(np.arange(len(points)) < seen, 0.0, 1.0)}

    labels = segment_known(FRAME, ONE_PIECE, recognize, locate)
    assert ((labels > 0) != (ONE_PIECE > 0)).sum() <= seen
    assert recognize.call_count < 5


@pytest.mark.parametrize(
    ("widths", "is_small", "found"),
    [((0.07, 0.07, 0.07), False, 3), ((0.07, 0.07, 0.07), True, 2), ((0.04, 0.04, 0.14), False, 1)],
)
def test_what_is_left_is_unknown_unless_it_is_small_or_large(
    widths: tuple[float, ...], is_small: bool, found: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = np.cumsum([-0.1, *widths])
    colors = RED, BLUE, (40, 160, 40)
    boxes = [Box((a + b) / 2, 0, ((b - a) / 2, 0.05), 0.06, c) for a, b, c in zip(ends, ends[1:], colors, strict=False)]
    frame = render(boxes, tilt=30, size=(480, 640))
    truth = frame.label_image
    if is_small:
        monkeypatch.setattr("thor2_jax.segmentation.known_objects.LEAST_PIXELS", (truth == 3).sum() * 1.2)
    recognize = knows(truth == 1, truth == 2, frame=frame)
    labels = segment_known(frame, (truth > 0).astype(np.int32), recognize, nowhere)
    assert labels.max() == found
    assert found < 3 or (best_overlaps(labels, truth) > 0.95).all()
    np.testing.assert_array_equal(labels > 0, truth > 0)


@pytest.mark.parametrize("known", [(4, 7), (4,)], ids=["both known", "one known"])
def test_pixels_go_to_the_object_on_whose_surface_they_lie(known: tuple[int, ...]) -> None:
    """Also the nearest pixels of the background; what lies on no known surface becomes a piece."""
    border = np.quantile(np.nonzero(TRUTH == 2)[1], 0.6)
    shifted = np.where(shrink(TRUTH > 0, 3), np.where(np.arange(640) < border, 4, 7), 0).astype(np.int32)
    surfaces = {4: surface_of(TRUTH == 1), 7: surface_of(TRUTH == 2)}
    shown: list[NDArray[np.integer]] = []

    def locate(frame: RGBDFrame) -> dict[int, Distances]:
        shown.append(frame.label_image)
        return {number if len(shown) == 1 else (4, 7).index(number) + 1: surfaces[number] for number in known}

    labels = fit_masks(FRAME, shifted, locate)
    np.testing.assert_array_equal(shown[0], shifted)
    assert not labels[TRUTH == 0].any() and len(shown) == 2
    if len(known) == 2:
        np.testing.assert_array_equal(labels > 0, TRUTH > 0)
        assert (best_overlaps(labels, TRUTH) > 0.99).all()
    else:
        far = surfaces[4](backproject(FRAME.depth_m, FRAME.intrinsics)[labels == 1]) > 0.015
        assert far.mean() < 0.01 and (labels[TRUTH == 1] == 1).mean() > 0.99


def test_small_pieces_go_to_the_nearest_one() -> None:
    labels = TRUTH.copy()
    rows, columns = np.nonzero(TRUTH == 1)
    labels[rows[:150], columns[:150]] = 3
    fitted = fit_masks(FRAME, labels, lambda frame: {1: lambda points: np.full(len(points), 0.01)})
    assert fitted.max() == 3 and (fitted > 0).sum() == (TRUTH > 0).sum()  # the only piece of a label stays
    far = fit_masks(FRAME, TRUTH, lambda frame: {1: lambda points: np.where(np.arange(len(points)) < 150, 1, 0.01)})
    assert (far != TRUTH).sum() < 10


def test_points_beyond_the_reach_of_a_surface_leave() -> None:
    near = surface_of(TRUTH == 1)

    def cut(points: NDArray[np.floating]) -> NDArray[np.float64]:
        distance = near(points)
        return np.where(distance > 0.02, np.inf, distance)

    labels = fit_masks(FRAME, ONE_PIECE, lambda frame: {1: cut})
    np.testing.assert_array_equal(labels, fit_masks(FRAME, ONE_PIECE, lambda frame: {1: near}))
    assert (labels[TRUTH == 2] != 1).mean() > 0.6


def test_labels_remain_without_known_objects_or_if_a_small_one_leaves() -> None:
    rows, columns = np.nonzero(TRUTH == 1)
    labels = np.zeros_like(TRUTH)
    np.testing.assert_array_equal(fit_masks(FRAME, labels, lambda frame: {}), labels)
    labels[rows[1000:1150], columns[1000:1150]] = 1
    fitted = fit_masks(FRAME, labels, lambda frame: {1: lambda points: np.full(len(points), 0.018)})
    np.testing.assert_array_equal(fitted, labels)
    labels = np.where(TRUTH == 2, 2, labels)
    center = backproject(FRAME.depth_m, FRAME.intrinsics)[labels == 1].mean(axis=0)
    for near in (0.0, 0.01):  # all of it leaves, or the rest

        def distances(points: NDArray[np.floating], near: float = near) -> NDArray[np.float64]:
            return np.where(np.linalg.norm(points - center, axis=1) < near, 0.0, 0.018)

        fitted = fit_masks(FRAME, labels, lambda frame, distances=distances: {1: distances})
        np.testing.assert_array_equal(fitted if near == 0 else np.where(labels > 0, fitted, 0), labels)


def test_separate_pieces_of_an_object_keep_its_number() -> None:
    """Those of an unknown object, too; what leaves an object is separate."""
    columns = np.arange(640)
    middle = round(np.nonzero(TRUTH)[1].mean())
    gap = np.where((TRUTH > 0) & (abs(columns - middle) > 8), 1, 0).astype(np.int32)
    rows, columns = np.nonzero((TRUTH == 0) & (FRAME.depth > 0))
    gap[rows[:400], columns[:400]] = 2
    for known, far in ((1, 0.01), (2, 0.01), (1, 0.02)):
        labels = fit_masks(FRAME, gap, lambda frame, known=known, far=far: {known: lambda p: np.full(len(p), far)})
        assert labels.max() == (3 if far > 0.015 else 2)


def test_points_stay_on_the_nearest_of_two_near_surfaces() -> None:
    """A pixel without depth keeps its label."""
    depth = FRAME.depth.copy()
    depth[TRUTH == 2] *= np.arange(640)[None].repeat(480, 0)[TRUTH == 2] % 7 > 0
    frame = RGBDFrame(FRAME.color, depth, None, FRAME.intrinsics)

    def distances(points: NDArray[np.floating]) -> NDArray[np.float64]:
        assert (points[:, 2] > 0).all()
        return np.full(len(points), 0.004)

    fitted = fit_masks(frame, TRUTH, lambda frame: {1: distances, 2: distances})
    assert (fitted == TRUTH)[TRUTH > 0].mean() > 0.97
    np.testing.assert_array_equal(fitted > 0, grow(TRUTH > 0, 3))


@pytest.mark.parametrize(("piece", "whole", "merged"), [(0.85, 0.9, 0), (0.85, 0.95, 1), (0.98, 1, 0), (0.96, 1, 1)])
def test_pieces_are_merged_where_the_odds_grow_by_one(piece: float, whole: float, merged: int) -> None:
    """Confidences above 0.99 count as 0.99."""
    size = ONE_PIECE.sum()
    recognize: Recognize = lambda frames: [  # noqa: E731
        ("a", whole if (frame.label_image == 1).sum() == size else piece) for frame in frames
    ]
    labels = segment_known(FRAME, TRUTH, recognize, nowhere)
    np.testing.assert_array_equal(labels, ONE_PIECE if merged else TRUTH)
