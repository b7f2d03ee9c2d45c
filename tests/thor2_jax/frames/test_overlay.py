"""Overlays of answers against outlines computed by SciPy and the rectangles of the drawn text."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageDraw
from refusals import assert_refused
from scipy import ndimage

import thor2_jax as thor2
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, draw_overlay

GREY = 90


def photo(height: int = 480, width: int = 640) -> np.ndarray:
    return np.full((height, width, 3), GREY, np.uint8)


def discs(centres: list[tuple[int, int]], radius: int, shape: tuple[int, int] = (480, 640)) -> np.ndarray:
    """Return the labels 1, 2, ... of discs around (row, column) centres."""
    row, column = np.indices(shape)
    labels = np.zeros(shape, np.uint8)
    for number, (r, c) in enumerate(centres, start=1):
        labels[(row - r) ** 2 + (column - c) ** 2 <= radius**2] = number
    return labels


def named(label: int, name: str = "mug", occluded: bool = False) -> thor2.Recognition:
    return thor2.Recognition(label=label, name=name, confidence=0.756, classifier="tops2", occluded=occluded)


def frame_of(color: np.ndarray, labels: np.ndarray) -> thor2.RGBDFrame:
    return thor2.RGBDFrame(color, np.zeros(labels.shape, np.uint16), labels, thor2.Intrinsics(1, 1, 0, 0))


def drawn(color: np.ndarray, labels: np.ndarray, answers: list[thor2.Recognition], path: Path) -> np.ndarray:
    before = color.copy(), labels.copy()
    draw_overlay(frame_of(color, labels), answers, path)
    assert np.array_equal(color, before[0]) and np.array_equal(labels, before[1])
    with Image.open(path) as picture:
        assert picture.format == "PNG" and picture.mode == "RGB"
        return np.asarray(picture)


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> list[tuple[tuple[int, int, int, int], str]]:
    """Record each label that is drawn: the rectangle behind it, last column and row included, and its text."""
    labels: list[tuple[tuple[int, int, int, int], str]] = []
    rectangle, text = ImageDraw.ImageDraw.rectangle, ImageDraw.ImageDraw.multiline_text
    last: list[tuple[int, int, int, int]] = []

    def with_rectangle(self: ImageDraw.ImageDraw, xy: tuple[int, int, int, int], **options: object) -> None:
        last.append(xy)
        rectangle(self, xy, **options)

    def with_text(self: ImageDraw.ImageDraw, xy: tuple[float, float], words: str, *rest: Any, **options: Any) -> None:
        left, top, right, bottom = self.multiline_textbbox(xy, words, rest[1], spacing=options["spacing"])
        box = last[-1]
        assert box[0] < left and box[1] < top and right <= box[2] and bottom <= box[3], "the text leaves its box"
        labels.append((box, words))
        text(self, xy, words, *rest, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "rectangle", with_rectangle)
    monkeypatch.setattr(ImageDraw.ImageDraw, "multiline_text", with_text)
    return labels


def outside(boxes: list[tuple[tuple[int, int, int, int], str]], shape: tuple[int, int]) -> np.ndarray:
    free = np.ones(shape, bool)
    for (left, top, right, bottom), _ in boxes:
        free[top : bottom + 1, left : right + 1] = False
    return free


def test_outlines_lie_on_the_inner_edge_of_touching_masks(tmp_path: Path, boxes: list) -> None:
    labels = discs([(250, 310), (300, 400)], 60)
    labels[300:320, 390:410] = 0  # holes have an outline too
    answers = [named(1), thor2.Recognition(label=2, reason="too few points")]
    picture = drawn(photo(), labels, answers, tmp_path / "a.png")
    free = outside(boxes, labels.shape)
    for answer, paint in zip(answers, (COLORS[0], UNRECOGNIZED), strict=True):
        mask = labels == answer.label
        rim = mask & ~ndimage.binary_erosion(mask, iterations=2) & free
        assert rim.sum() > 500
        assert (picture[rim] == paint).all()
        inside = ndimage.binary_erosion(mask, iterations=5) & free
        assert inside.sum() > 5000
        assert (picture[inside] == GREY).all()


def test_labels_are_complete_and_do_not_overlap(tmp_path: Path, boxes: list) -> None:
    labels = discs([(5, 5), (5, 630), (470, 5), (470, 630), (240, 320), (244, 320), (248, 320)], 40)
    answers = {
        "1: mug 0.76\nTOPS2": named(1, "mug"),
        "2: bowl 0.76\nTOPS2, occluded": named(2, "bowl", occluded=True),
        "3: unrecognized": thor2.Recognition(label=3, reason="too few points"),
        "4: unrecognized\noccluded": thor2.Recognition(label=4, occluded=True, reason="too few points"),
        "5: plate 1.00\nTOPS": thor2.Recognition(label=5, name="plate", confidence=1.0, classifier="tops"),
        "6: pitcher 0.76\nTOPS2": named(6, "pitcher"),
        "7: spoon": thor2.Recognition(label=7, name="spoon"),
    }
    drawn(photo(), labels, list(answers.values()), tmp_path / "a.png")
    assert [text for _, text in boxes] == list(answers)
    areas = [(right + 1 - left) * (bottom + 1 - top) for (left, top, right, bottom), _ in boxes]
    assert sum(areas) == (~outside(boxes, labels.shape)).sum()  # smaller if labels overlap or leave the picture


def test_text_is_legible_on_its_box(tmp_path: Path, boxes: list) -> None:
    labels = discs([(100, 100), (100, 300), (100, 500), (350, 100), (350, 300), (350, 500)], 40)
    answers = [*(named(k) for k in range(1, 6)), thor2.Recognition(label=6)]
    picture = drawn(photo(), labels, answers, tmp_path / "a.png")
    for (box, _), paint in zip(boxes, (*COLORS, UNRECOGNIZED), strict=True):
        inside = picture[box[1] : box[3] + 1, box[0] : box[2] + 1].reshape(-1, 3)
        ink = (255, 255, 255) if paint == (0, 114, 178) else (0, 0, 0)
        assert (inside == paint).all(axis=1).mean() > 0.5
        assert 0.02 < (inside == ink).all(axis=1).mean() < 0.5


def test_a_leader_connects_a_label_with_its_instance(tmp_path: Path, boxes: list) -> None:
    labels = np.zeros((480, 640), np.uint8)
    labels[140:340, 220:420] = 1  # surrounds a small instance, whose label must move away
    labels[238:242, 318:322] = 2
    picture = drawn(photo(), labels, [named(1), named(2)], tmp_path / "a.png")
    ((left, top, right, bottom), _) = boxes[1]
    assert not (left <= 321 and right >= 318 and top <= 241 and bottom >= 238)
    joined, _ = ndimage.label((picture == COLORS[1]).all(axis=2), np.ones((3, 3)))
    assert joined[238, 318] == joined[top, left] > 0


def test_long_names_shrink_to_fit(tmp_path: Path, boxes: list) -> None:
    labels = discs([(60, 80)], 20, (120, 160))
    drawn(photo(120, 160), labels, [named(1, "an_object_of_long_name")], tmp_path / "a.png")
    (((left, _, right, _), text),) = boxes
    assert text.startswith("1: an_object_of_long_name 0.76") and 0 <= left < right < 160


def test_sizes_scale_with_the_image(tmp_path: Path, boxes: list) -> None:
    for scale in (1, 3):
        labels = discs([(240 * scale, 320 * scale)], 60 * scale, (480 * scale, 640 * scale))
        picture = drawn(photo(*labels.shape), labels, [named(1)], tmp_path / f"{scale}.png")
        line = (picture[240 * scale] == COLORS[0]).all(axis=1)[200 * scale : 290 * scale]
        assert line.sum() == round(800 * scale / 350)
    heights = [bottom - top for (_, top, _, bottom), _ in boxes]
    assert heights[1] > 1.8 * heights[0]


def test_tiny_pictures_have_outlines_without_labels(tmp_path: Path, boxes: list) -> None:
    labels = np.zeros((8, 8), np.uint64)
    labels[1:7, 1:7], labels[7, 7] = 1, 2
    picture = drawn(photo(8, 8), labels, [named(1), thor2.Recognition(label=2)], tmp_path / "a.png")
    assert boxes == []
    assert (picture[1, 1:7] == COLORS[0]).all() and (picture[7, 7] == UNRECOGNIZED).all()
    assert (picture[3:5, 3:5] == GREY).all() and (picture[0] == GREY).all()
    assert (drawn(photo(1, 1), np.ones((1, 1), int), [named(1)], tmp_path / "b.png") == COLORS[0]).all()
    assert np.array_equal(drawn(picture, labels, [], tmp_path / "a.png"), picture)


def test_answers_for_other_labels_are_refused(tmp_path: Path) -> None:
    frame = frame_of(photo(), discs([(100, 100)], 20))
    for label in (0, 4, -1, 300):
        assert_refused(f"answers: label {label} ", draw_overlay, frame, [named(1), named(label)], tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "text"),
    [("Tasse ä", "Tasse ä"), ("\U0001f34e", r"\U0001f34e"), ("a\u202eb", r"a\u202eb"), ("\x1b", r"\x1b")],
)
def test_missing_characters_are_escaped(name: str, text: str, tmp_path: Path, boxes: list) -> None:
    drawn(photo(), discs([(100, 40)], 20), [thor2.Recognition(label=1, name=name)], tmp_path / "a.png")
    assert boxes[0][1] == f"1: {text}"
