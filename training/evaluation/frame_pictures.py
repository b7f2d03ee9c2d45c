"""Pictures of an evaluation: frames with judged answers, and crops of instances."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.files import write_bytes
from thor2_jax.frames.frames import encode_image
from thor2_jax.frames.overlay import COLORS, UNRECOGNIZED, Annotation, draw_instances
from training.evaluation.answers import FrameAnswers
from training.evaluation.results import named_answers
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrames

__all__ = ["CORRECT", "INCORRECT", "draw_crop", "draw_judged", "draw_pictures"]

FRAMES = 12
"""Number of frames drawn, evenly spread over the dataset."""


def draw_pictures(
    frames: LabelledFrames,
    answers: Sequence[FrameAnswers],
    runs: Sequence[Run],
    confusions: Sequence[tuple[str, str]],
    out: Path,
) -> tuple[list[str], list[dict[str, Any]]]:
    """Draw some frames with the answers of the first run, and the most confident instance of each confusion.

    The pictures are `frames/<k>.jpg` and `confusions/<k>.jpg`, with k counted from 0.

    Args:
        frames: the dataset.
        answers: answers for all of its frames.
        runs: evaluated runs.
        confusions: object and wrong name of confusions that occur in the answers.
        out: directory of the report.

    Returns:
        The identifiers of the drawn frames, and "frame", the identifier, and "label" of each drawn instance.

    Raises:
        InputError: a frame cannot be read.
        OSError: a file cannot be written.
    """
    instances = [instance for each in answers for instance in each.instances]
    frame_of = {id(instance): number for number, each in enumerate(answers) for instance in each.instances}
    named = [(confidence, i, (i.truth, name)) for _, i, name, confidence in named_answers(instances, runs)]
    drawn = []
    for k, confusion in enumerate(confusions):
        _, instance, _ = max((each for each in named if each[-1] == confusion), key=lambda each: each[0])
        number = frame_of[id(instance)]
        drawn.append({"frame": frames.identifiers[number], "label": instance.label})
        frame = frames[number].frame
        draw_crop(frame.color, frame.label_image == instance.label, out / "confusions" / f"{k}.jpg")
    numbers = sorted({int(n) for n in np.linspace(0, len(frames) - 1, FRAMES)})
    for k, number in enumerate(numbers):
        frame = frames[number].frame
        draw_judged(frame.color, frame.label_image, _judge(answers[number], runs), out / "frames" / f"{k}.jpg")
    return [frames.identifiers[number] for number in numbers], drawn


def _judge(answers: FrameAnswers, runs: Sequence[Run]) -> list[Annotation]:
    """Return the answers of the first run, incorrect ones first; unknown objects should be rejected."""
    names = {i.label: name for run, i, name, _ in named_answers(answers.instances, runs) if run == 0}
    judged = []
    for instance in answers.instances:
        name, is_known = names.get(instance.label), instance.truth in runs[0].classes
        color = CORRECT if name == (instance.truth if is_known else None) else INCORRECT
        text = name or ("unknown" if instance.label in names else "none")
        text = text if name == instance.truth else f"{text} ({instance.truth})"
        judged.append(Annotation(instance.label, color, text))
    return sorted(judged, key=lambda each: each.paint == CORRECT)


CORRECT, INCORRECT = COLORS[2], UNRECOGNIZED
"""Bluish green and vermilion from the palette of Okabe and Ito, which people with colour blindness can distinguish."""

_LARGEST_WIDTH = 960
"""Largest width of a picture, pixels; wider frames are reduced."""

_CROP_SIDE = 240
"""Longest side of a crop, pixels."""


def _save(picture: Image.Image, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, encode_image(picture, "JPEG", quality=85, subsampling=0))


def draw_judged(color: NDArray[np.uint8], labels: NDArray[Any], judged: Sequence[Annotation], path: Path) -> None:
    """Draw the outline and the text of every judged instance (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        labels: [H, W] integers.
        judged: instances, green if correct and red if incorrect; texts are placed in this order. Labels without a pixel
            are skipped.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    step = max(1, math.ceil(labels.shape[1] / _LARGEST_WIDTH))
    color, labels = color[::step, ::step], labels[::step, ::step]
    _save(draw_instances(color, labels, [each for each in judged if (labels == each.label).any()]), path)


def draw_crop(color: NDArray[np.uint8], mask: NDArray[np.bool_], path: Path) -> None:
    """Draw an instance with its outline in red and a margin around it (JPEG).

    Args:
        color: [H, W, 3] uint8, sRGB.
        mask: [H, W] bool, the pixels of the instance; not empty.
        path: path of the picture.

    Raises:
        OSError: the file cannot be written.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    margin = 6 + max(np.ptp(rows), np.ptp(columns)) // 8
    window = tuple(slice(max(0, int(s[0]) - margin), int(s[-1]) + margin + 1) for s in (rows, columns))
    picture = draw_instances(color[window], mask[window].astype(np.uint8), [Annotation(1, INCORRECT, "")])
    scale = _CROP_SIDE / max(picture.size)
    _save(picture.resize((max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))), path)
