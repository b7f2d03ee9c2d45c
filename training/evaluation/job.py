"""A whole evaluation: every frame answered once, then `report.json` for machines and `report.html` for people.

REPORT/answers.jsonl               what every classifier said, frame by frame; an evaluation that was stopped goes on
REPORT/report.json, report.html    written last
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from thor2_jax.config import DESCRIPTOR_VERSION
from thor2_jax.errors import InputError
from thor2_jax.files import check_output_directory, write_text
from training.evaluation.answers import AnswerFile, FrameAnswers, answer_frame, columns
from training.evaluation.frame_pictures import Gallery
from training.evaluation.page import WORST, write_report_page
from training.evaluation.results import results
from training.evaluation.runs import Run
from training.readers.labelled import LabelledFrames
from training.storage.locks import locked

__all__ = ["evaluate_dataset"]

ANSWERS = "answers.jsonl"


def evaluate_dataset(
    runs: Sequence[Run],
    frames: LabelledFrames,
    dataset: Mapping[str, str],
    out: Path,
    progress: Callable[[str, int, int, str], object] = lambda stage, done, total, note: None,
) -> dict[str, Any]:
    """Answer every frame that is not answered yet, and write the report.

    A frame is described once, whatever the number of runs; its answers are kept before the next one is begun.

    Args:
        runs: as `load_runs` or `load_sequence_runs` gives them.
        frames: the dataset.
        dataset: "kind" (uwis, ocid, bop, frames), "path", and whatever else the frames depend on.
        out: folder of the report: new, empty, or of the same evaluation.
        progress: told (stage, frames done, frames in all, rate).

    Returns:
        What is in report.json.

    Raises:
        InputError: `out` holds something else, or answers of other runs, another dataset or another descriptor; another
            process evaluates into it; or a frame cannot be read. Answers so far stay.
        OSError: something cannot be written.
    """
    check_output_directory(out, ANSWERS)
    with locked(out):
        return _evaluate(runs, frames, dataset, out, progress)


def _evaluate(
    runs: Sequence[Run],
    frames: LabelledFrames,
    dataset: Mapping[str, str],
    out: Path,
    progress: Callable[[str, int, int, str], object],
) -> dict[str, Any]:
    classes, asked = runs[0].classes, columns(runs)
    description = {**dataset, "frames": len(frames)}
    file = AnswerFile(
        out / ANSWERS,
        {
            "dataset": description,
            "descriptor_version": DESCRIPTOR_VERSION,
            "runs": [run.digest for run in runs],
            "classifiers": [[r, name] for r, name in asked],
        },
    )
    for number, (answers, identifier) in enumerate(zip(file.frames, frames.identifiers, strict=False)):
        if answers.frame != identifier:
            raise InputError(
                f"out: the answers to frame {number} are to {answers.frame!r}, but the dataset has {identifier!r} "
                "there; name another folder"
            )
    gallery = Gallery(out, asked, classes, len(frames))
    for answers in file.frames:
        gallery.recall(answers)
    progress("evaluate", len(file.frames), len(frames), "")
    _answer_rest(runs, frames, file, gallery, progress)
    temperatures = [run.temperatures for run in runs]
    found = {
        "dataset": description,
        "digests": [run.digest for run in runs],
        **results(dataset["kind"], file.frames, asked, [run.name for run in runs], classes, temperatures),
    }
    found["worst"] = _worst(found)
    found["shown"] = [file.frames[number].frame for number in gallery.shown]
    write_report_page(found, gallery, out)
    write_text(out / "report.json", json.dumps(found, indent=1) + "\n")
    return found


def _answer_rest(
    runs: Sequence[Run],
    frames: LabelledFrames,
    file: AnswerFile,
    gallery: Gallery,
    progress: Callable[[str, int, int, str], object],
) -> None:
    before, begun = len(file.frames), time.perf_counter()
    for number in range(before, len(frames)):
        start = time.perf_counter()
        item = frames[number]
        instances = answer_frame(runs, item)
        answers = FrameAnswers(item.identifier, item.attributes, time.perf_counter() - start, instances)
        gallery.add(number, item, answers)  # before the frame counts as done
        file.append(answers)
        rate = (number + 1 - before) / (time.perf_counter() - begun)
        progress("evaluate", number + 1, len(frames), f"{rate:.2f} frames/s, {item.identifier}")


def _worst(found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The most frequent confusions; what could not be described is none."""
    classes = found["classes"]
    pairs = [
        {"truth": truth, "answer": answer, "count": row[j], "share": row[j] / sum(row)}
        for i, (truth, row) in enumerate(zip(classes, found.get("confusion", []), strict=False))
        for j, answer in enumerate(classes)
        if i != j and row[j]
    ]
    return sorted(pairs, key=lambda pair: -pair["count"])[:WORST]
