"""`thor2 recognize --bag`: recognize the frames of a recording."""

import contextlib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from training.cli import options
from training.cli.app import finish

if TYPE_CHECKING:
    from training.frame_recognition import RecognizerArguments

__all__ = ["recognize_bag"]


def recognize_bag(
    given: options.FrameOptions,
    arguments: "RecognizerArguments",
    segment: str | None,
    track: bool,
    out: Path | None,
    out_bag: Path | None,
    rerun: Path | None,
) -> None:
    """Recognize the frames of a recording: a line of JSON for each, and the outputs that are wanted.

    Raises:
        InputError: the recording cannot be read from here on, and what was written so far; or frames failed.
    """
    from thor2_jax.files import check_output_directory
    from thor2_jax.model.recognition import detections_as_json, detections_of
    from thor2_jax.model.result_files import write_recognitions
    from thor2_jax.recordings.bag_writer import DetectionBag
    from thor2_jax.recordings.rerun_file import RerunFile
    from thor2_jax.segmentation.segmenters import MODEL, TABLE, load_segmenter
    from training.frame_recognition import recognize_recorded, segmentation_failure

    # The segmenter "model" begins with the pieces of "table", whose package must be there, too.
    table = load_segmenter(TABLE if segment in (None, MODEL) else segment)
    segmenter = None if segment == MODEL else table
    bag = given.open_bag()
    detection_bag = None if out_bag is None else DetectionBag(out_bag)
    rerun_file = None if rerun is None else RerunFile(rerun)
    if out is not None:
        check_output_directory(out)

    n_answers, n_failed, without_depth, damage = 0, 0, [], None
    with bag:
        for note in bag.notes:
            print(escape_characters(f"note: {note}"), file=sys.stderr)
        recognizer = arguments.load()
        recognize = recognizer.track().update if track else recognizer.recognize
        with detection_bag or contextlib.nullcontext(), rerun_file or contextlib.nullcontext():
            try:
                by = segmenter or recognizer.segment
                for recorded, answer in recognize_recorded(recognize, bag.frames(), by, given.every):
                    line, frame = {"frame": recorded.name, "depth_gap": recorded.gap / 1e9}, answer.frame
                    if frame is None:
                        n_failed += 1
                        print(escape_characters(f"failed: {answer.name}: {answer.error}"), file=sys.stderr)
                        print(json.dumps({**line, "error": answer.error}), flush=True)
                        continue
                    n_answers += 1
                    without_depth.append(segmentation_failure(answer))
                    detections = detections_of(frame, answer.recognitions)
                    print(json.dumps({**line, "instances": detections_as_json(detections)}), flush=True)
                    if out is not None:
                        write_recognitions(out / recorded.name, frame, answer.recognitions)
                    if detection_bag is not None:
                        detection_bag.write(frame, detections, stamp=recorded.stamp, frame_id=recorded.frame_id)
                    if rerun_file is not None:
                        rerun_file.write(frame, detections, name=recorded.name, stamp=recorded.stamp)
            except InputError as error:
                damage = str(error)
    written = [str(path) for path in (out, out_bag, rerun) if path is not None and n_answers and path.exists()]
    if damage is not None:
        kept = f"; {n_answers} frames were recognized before" + (f" and are in {', '.join(written)}" if written else "")
        raise InputError(damage + (kept if n_answers else ""))
    unpaired = bag.counts.color - bag.counts.pairs
    if unpaired:
        without = f"images of {bag.topics.color} have no depth within {given.max_gap:g} s"
        print(escape_characters(f"{unpaired} of {bag.counts.color} {without}"), file=sys.stderr)
    result = f"written to {', '.join(written)}" if written else f"frames recognized: {n_answers}"
    segmented = ["--segment", segment] if segment else []
    again = ["explain", *given.arguments, *segmented, *options.given_options(arguments), "--out", "why"]
    finish(result, "see why", *again, file=sys.stderr)
    if n_failed:
        raise InputError(f"{n_failed} of {n_answers + n_failed} frames could not be recognized; see above")
    if without_depth and all(without_depth):
        raise InputError(without_depth[0])
