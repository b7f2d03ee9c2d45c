"""`thor2 recognize`: recognize the instances of frames."""

import contextlib
import functools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from training.cli import options
from training.cli.app import app, console, finish
from training.cli.recognize_bag import recognize_bag

if TYPE_CHECKING:
    from thor2_jax.model.recognition import Recognition

MAX_LISTED = 5
"""Failed frames that the last line lists."""


@app.command()
@options.grouped_options
def recognize(
    model: options.ModelOption,
    given: options.FrameOptions,
    processes: options.WorkerOptions,
    segment: options.KnownSegmentOption = None,
    unknown_below: options.UnknownOption = None,
    answer_by: options.AnswerByOption = None,
    track: Annotated[
        bool, typer.Option("--track", help="The frames are a sequence: follow the objects and fuse their answers.")
    ] = False,
    poses: Annotated[
        Path | None, typer.Option(help="JSON of camera poses for --track: frame -> 4 x 4 matrix, camera to world.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory for recognition.json and overlay.png, of each FRAME in OUT/<frame>.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one line of JSON for each frame.")] = False,
    coco: Annotated[Path | None, typer.Option(metavar="FILE", help="Write COCO results (JSON with masks).")] = None,
    bop: Annotated[Path | None, typer.Option(metavar="FILE", help="Write BOP results (CSV, without poses).")] = None,
    names: Annotated[
        Path | None, typer.Option(help="YAML or JSON table for --coco and --bop: number -> name of the object.")
    ] = None,
    rerun: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write an .rrd file for the Rerun viewer (extra rerun).")
    ] = None,
    out_bag: Annotated[
        Path | None,
        typer.Option(
            rich_help_panel=options.RECORDINGS, help="Write detections: MCAP (.mcap), or directory of a ROS 2 bag."
        ),
    ] = None,
) -> None:
    """Recognize every instance of RGB-D frames.

    A frame that cannot be recognized does not stop the others; the command then ends with exit code 2. With --track,
    the frames of one camera are a sequence in the order of their names: an object has one name in all of them.
    """
    from thor2_jax.files import check_output_directory, check_output_file, remove_leftovers
    from thor2_jax.model import result_files
    from thor2_jax.model.recognition import detections_of
    from thor2_jax.recordings.rerun_file import RerunFile
    from training.frame_recognition import (
        RecognizerArguments,
        ResultTables,
        recognize_frames,
        recognize_frames_in_pool,
        segmentation_failure,
        track_frames,
    )
    from training.readers.bop import read_object_names
    from training.readers.frame_files import read_poses

    given.check()
    arguments = RecognizerArguments(model, unknown_below, answer_by)
    if given.bag is not None:
        refused: dict[str, object] = {"names": names, "coco": coco, "bop": bop, "poses": poses}
        for name, value in {**refused, "workers": processes.workers, "engine": processes.engine}.items():
            if value not in (None, 1, "local"):
                raise InputError(f"{name} is {value} and bag is {given.bag}; give one of them")
        recognize_bag(given, arguments, segment, track, out, out_bag, rerun)
        return
    if out_bag is not None:
        raise InputError(f"out_bag is {out_bag}; it belongs to --bag")
    if names is not None and coco is None and bop is None:
        raise InputError(f"names is {names}; it belongs to --coco and --bop")
    if poses is not None and not track:
        raise InputError(f"poses is {poses}; it belongs to --track")
    pool = processes.pool()
    if pool is not None and (track or not given.frames):
        reason = "--track, which takes the frames in turn" if track else "one frame"
        raise InputError(
            f"workers is {processes.workers} and engine is {processes.engine}; they are of no use for {reason}: leave "
            "them out"
        )
    load = functools.cache(arguments.load)
    by_model = (lambda frame: load().segment(frame)) if pool is None else arguments.segment
    sources, frames = given.sources(segment, by_model), given.frames
    of_frames = None if poses is None else read_poses(poses, [source.name for source in sources])
    if out is not None:
        first_parts = {source.name.split("/")[0] for source in sources}
        check_output_directory(out, resumable=first_parts if frames else result_files.RESULT_FILES)
        for directory in [out / source.name for source in sources] if frames else [out]:
            result_files.check_no_foreign_results(directory)
            remove_leftovers(directory)
    if coco is not None and bop is not None and coco.absolute() == bop.absolute():
        raise InputError(f"coco and bop are {coco}; expected two files")
    rerun_file = None if rerun is None else RerunFile(rerun)
    numbers = None if names is None else read_object_names(names)
    check_output_file("coco", coco, result_files.is_coco_file)
    check_output_file("bop", bop, result_files.is_bop_file)
    segmented = ["--segment", segment] if segment else []
    recognizer = load()
    tables = ResultTables([source.name for source in sources], recognizer.classes, numbers)
    failed, without_depth, unknown = [], [], False
    if pool is not None:
        answers = recognize_frames_in_pool(arguments, sources, pool)
    else:
        answers = track_frames(recognizer, sources, of_frames) if track else recognize_frames(recognizer, sources)
    with rerun_file or contextlib.nullcontext():
        for answer in answers:
            if answer.frame is None:
                failed.append(answer.name)
                if not frames:
                    raise InputError(str(answer.error))
                print(escape_characters(f"failed: {answer.name}: {answer.error}"), file=sys.stderr)
            if as_json:
                print(json.dumps(answer.as_json()), flush=True)
            if answer.frame is None:
                continue
            if rerun_file is not None:
                rerun_file.write(answer.frame, detections_of(answer.frame, answer.recognitions), name=answer.name)
            without_depth.append(segment and segmentation_failure(answer))
            if not as_json:
                _print_table(answer.name if frames else None, answer.recognitions)
            unknown |= any(each.name is None for each in answer.recognitions)
            tables.add(answer)
            if out is not None:
                directory = out / answer.name if frames else out
                result_files.write_recognitions(directory, answer.frame, answer.recognitions)
    tables.write(coco, bop)
    written = ", ".join(str(path) for path in (out, coco, bop, rerun) if path)
    result = f"written to {written}" if written else f"frames recognized: {len(sources) - len(failed)}"
    notes = sys.stderr if as_json else None
    if unknown:
        print(escape_characters(f"{model} knows {recognizer.model.union.summary}"), file=notes)
    next_command = ("explain", *given.arguments, *segmented, *options.given_options(arguments), "--out", "why")
    finish(result, "see why", *next_command, file=notes)
    if tables.n_without_number and (coco or bop):
        print(f"{tables.n_without_number} instances have a name that {names} does not number", file=sys.stderr)
    if failed:
        listed = ", ".join(failed[:MAX_LISTED]) + (", ..." if len(failed) > MAX_LISTED else "")
        raise InputError(f"{len(failed)} of {len(sources)} frames could not be recognized: {listed}; see above")
    if all(without_depth):
        raise InputError(str(without_depth[0]))


def _print_table(frame: str | None, recognitions: Sequence["Recognition"]) -> None:
    tracked = any(hasattr(r, "track") for r in recognitions)
    table = Table(
        *["track"] * tracked, "label", "name", "confidence", "classifier", "occluded", "points", "overflow", "note"
    )
    for r in recognitions:
        confidence = "" if r.confidence is None else f"{r.confidence:.3f}"
        note = r.reason or ("outlier filter relaxed" if r.kept_by_fallback else "")
        name = escape_characters(r.name or "unrecognized")
        occluded = "yes" if r.occluded else "no"
        row = (str(r.label), name, confidence, r.classifier or "", occluded, str(r.points_used), str(r.overflow), note)
        table.add_row(*[str(getattr(r, "track", "") or "")] * tracked, *row)
    if frame is not None:
        console.print(f"{escape_characters(frame)}:")
    console.print(table)
