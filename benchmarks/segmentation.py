"""Comparison of segmentation with true masks: `python -m benchmarks.segmentation GROUP... [--model RUN]`.

A GROUP is a pattern of frame folders, such as "frames/kitchen/*". An instance is found if its intersection over
union with a piece is above 0.75. It is over-segmented if two pieces lie in it and cover a tenth of it each. It is
under-segmented if a piece covers half of it and a quarter of another instance. With --model, instances are recognized
with the true and with the segmented masks.
"""

import argparse
import dataclasses
import glob
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.recognizer import Recognizer
from thor2_jax.segmentation.segmenters import MODEL, load_segmenter, segment
from training.readers.frames import FrameFolder
from training.readers.labelled import LabelledFrame

FOUND = 0.75
"""Smallest intersection over union at which an instance is found."""

THIN = ("pen_", "marker", "scissors", "fork", "knife", "spoon")
"""Name prefixes of thin objects, at most 2 cm thick."""

REPEATS = 5


def overlaps(labels: NDArray[Any], truth: NDArray[Any]) -> NDArray[np.int64]:
    """Return the number of pixels that each true instance (row) shares with each piece (column)."""
    n = int(labels.max()) + 1
    pairs = np.bincount((truth.astype(np.int64) * n + labels).ravel(), minlength=(int(truth.max()) + 1) * n)
    return pairs.reshape(-1, n)


def compare(labels: NDArray[Any], item: LabelledFrame) -> tuple[list[dict[str, Any]], int]:
    """Return a row for each named instance of a frame, and the number of pieces on the background."""
    common = overlaps(labels, item.frame.label_image)
    truth_size, size = common.sum(axis=1), common.sum(axis=0)
    union = truth_size[:, None] + size - common
    share = common / np.maximum(truth_size, 1)[:, None]
    rows = []
    for number in sorted(set(item.truth) & set(item.frame.instances)):
        iou = (common[number] / np.maximum(union[number], 1))[1:]
        best = int(iou.argmax()) + 1 if len(iou) else 0
        parts = (share[number, 1:] >= 0.1) & (common[number, 1:] >= 0.5 * size[1:])
        others = np.delete(share[1:, 1:], number - 1, axis=0)
        shared = (share[number, 1:] >= 0.5) & (others >= 0.25).any(axis=0)
        rows.append(
            {
                "label": number,
                "name": item.truth[number],
                "iou": float(iou[best - 1]) if best else 0.0,
                "piece": best,
                "over": bool(parts.sum() > 1),
                "under": bool(shared.any()),
            }
        )
    return rows, int((common[0, 1:] > 0.75 * size[1:]).sum())


def timed(segmenter: Any, item: LabelledFrame) -> tuple[NDArray[Any], float, float]:
    """Return the labels of a frame, and the shortest elapsed and processor time of several runs, in seconds."""
    elapsed, processor = [], []
    for _ in range(REPEATS):
        start, start_processor = time.perf_counter(), time.process_time()
        labels = segment(item.frame, segmenter)
        elapsed.append(time.perf_counter() - start)
        processor.append(time.process_time() - start_processor)
    return labels, min(elapsed), min(processor)


def names_of(recognizer: Recognizer, item: LabelledFrame, labels: NDArray[Any]) -> dict[int, str | None]:
    """Return label -> recognized name."""
    return {r.label: r.name for r in recognizer.recognize(dataclasses.replace(item.frame, labels=labels))}


def measure(items: Sequence[LabelledFrame], segmenter: Any, recognizer: Recognizer | None) -> dict[str, Any]:
    """Return the figures of a group of frames."""
    rows: list[dict[str, Any]] = []
    extra, times = 0, []
    for item in items:
        labels, *seconds = timed(segmenter, item)
        times.append(seconds)
        of_frame, on_background = compare(labels, item)
        extra += on_background
        if recognizer is not None:
            with_truth = names_of(recognizer, item, item.frame.label_image)
            with_pieces = names_of(recognizer, item, labels)
            for row in of_frame:
                row["correct"] = with_truth.get(row["label"]) == row["name"]
                row["correct_piece"] = with_pieces.get(row["piece"]) == row["name"]
        rows += of_frame
    is_found = np.array([row["iou"] > FOUND for row in rows])
    thick = np.array([not row["name"].startswith(THIN) for row in rows])
    elapsed, processor = np.median(times, axis=0) * 1000
    report: dict[str, Any] = {
        "frames": len(items),
        "instances": len(rows),
        "found": float(is_found.mean()),
        "thick": int(thick.sum()),
        "thick found": float(is_found[thick].mean()),
        "over-segmented": float(np.mean([row["over"] for row in rows])),
        "under-segmented": float(np.mean([row["under"] for row in rows])),
        "pieces on the background in a frame": extra / len(items),
        "ms": float(elapsed),
        "ms of processor time": float(processor),
    }
    if recognizer is not None:
        correct = np.array([row["correct"] for row in rows])
        correct_piece = np.array([row["correct_piece"] for row in rows])
        report["accuracy, true masks"] = float(correct.mean())
        report["accuracy of the found, true masks"] = float(correct[is_found].mean())
        report["accuracy of the found, segmented"] = float(correct_piece[is_found].mean())
    return report


def main() -> None:
    """Print and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="+")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--segment", default="table")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "segmentation.json")
    options = parser.parse_args()
    recognizer = None if options.model is None else Recognizer.load(options.model)
    segmenter = recognizer.segment if recognizer and options.segment == MODEL else load_segmenter(options.segment)
    report = json.loads(options.out.read_text()) if options.out.exists() else {}
    for group in options.groups:
        items = [item for folder in sorted(glob.glob(group)) for item in FrameFolder(folder)]
        names = {name for item in items for name in item.truth.values()}
        known = recognizer if recognizer and names & {*recognizer.classes} else None
        report[Path(group).parent.name + "/" + Path(group).name] = figures = measure(items, segmenter, known)
        print(group, json.dumps(figures, indent=1))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
