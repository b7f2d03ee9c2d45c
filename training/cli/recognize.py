"""`thor2 recognize`: recognize the instances of frames."""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from thor2_jax.recordings.pairs import DEFAULT_MAX_GAP
from thor2_jax.recordings.topics import Topics
from training.cli.app import ModelOption, UnknownOption, app, console
from training.cli.recognize_bag import BagOptions, recognize_bag
from training.cli.workers import AddressOption, EngineOption, WorkersOption, worker_pool

if TYPE_CHECKING:
    from thor2_jax.recognition.answers import Recognition
    from thor2_jax.recordings.rerun_file import RerunFile
    from training.frame_recognition import FrameAnswer
    from training.readers.frame_files import FrameSource

RECORDINGS = "Recordings"
"""Panel of the options of recordings in the help."""

MAX_LISTED = 5
"""Failed frames that the last line lists."""


@app.command()
def recognize(
    model: ModelOption,
    frames: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FRAME]...", help="Folders of frames, or frames: color, depth, mask, intrinsics."),
    ] = None,
    color: Annotated[Path | None, typer.Option(help="Color image, PNG or JPEG, in place of FRAME.")] = None,
    depth: Annotated[Path | None, typer.Option(help="Depth image: 16-bit PNG, float TIFF, NPY or EXR.")] = None,
    labels: Annotated[Path | None, typer.Option(help="Instance labels, PNG; 0 is background.")] = None,
    segment: Annotated[
        str | None, typer.Option(help="Segment the frames instead of reading labels: table, or another segmenter.")
    ] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="fx, fy, cx, cy in JSON, ROS camera_info, K, BOP, RealSense or Open3D.")
    ] = None,
    depth_scale: Annotated[
        float | None, typer.Option(help="Depth units per metre. Default: that of the intrinsics, or 1000.")
    ] = None,
    unknown_below: UnknownOption = None,
    answer_by: Annotated[
        str | None, typer.Option(help="classifiers, gallery or both. Default: what the run has.")
    ] = None,
    track: Annotated[
        bool, typer.Option("--track", help="The frames are a sequence: follow the objects and fuse their answers.")
    ] = False,
    workers: WorkersOption = 1,
    engine: EngineOption = "local",
    address: AddressOption = None,
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
    bag: Annotated[
        Path | None,
        typer.Option(rich_help_panel=RECORDINGS, help="ROS 1 bag, ROS 2 bag or MCAP, in place of FRAME (extra bags)."),
    ] = None,
    color_topic: Annotated[
        str | None, typer.Option(rich_help_panel=RECORDINGS, help="Colour images. Default: the topic that has them.")
    ] = None,
    depth_topic: Annotated[
        str | None, typer.Option(rich_help_panel=RECORDINGS, help="Depth that is aligned to colour. Default: likewise.")
    ] = None,
    camera_topic: Annotated[
        str | None,
        typer.Option(rich_help_panel=RECORDINGS, help="camera_info of the colour camera. Default: likewise."),
    ] = None,
    max_gap: Annotated[
        float, typer.Option(rich_help_panel=RECORDINGS, help="Longest time between colour and depth, seconds.")
    ] = DEFAULT_MAX_GAP,
    every: Annotated[
        int, typer.Option(min=1, rich_help_panel=RECORDINGS, help="Recognize the first of so many frames.")
    ] = 1,
    out_bag: Annotated[
        Path | None,
        typer.Option(rich_help_panel=RECORDINGS, help="Write detections: MCAP (.mcap), or directory of a ROS 2 bag."),
    ] = None,
) -> None:
    """Recognize every instance of RGB-D frames.

    A frame that cannot be recognized does not stop the others; the command then ends with exit code 2. With --track,
    the frames of one camera are a sequence in the order of their names: an object has one name in all of them.
    """
    from thor2_jax.files import check_output_directory, remove_leftovers
    from thor2_jax.recognition.result_files import RESULT_FILES, write_recognitions
    from thor2_jax.recordings.rerun_file import RerunFile
    from training.frame_recognition import (
        RecognizerArguments,
        ResultTables,
        recognize_frames,
        recognize_frames_in_pool,
        track_frames,
    )
    from training.readers.bop import read_object_names
    from training.readers.poses import read_poses

    if bag is not None:
        refused: dict[str, object] = {"FRAME": frames, "color": color, "depth": depth, "labels": labels, "names": names}
        refused |= {"coco": coco, "bop": bop, "poses": poses, "workers": workers if workers > 1 else None}
        refused["engine"] = engine if engine != "local" else None
        given = [name for name, value in refused.items() if value]
        if given:
            raise InputError(f"{given[0]} is {refused[given[0]]} and bag is {bag}; give one of them")
        topics = Topics(color_topic, depth_topic, camera_topic)
        options = BagOptions(bag, topics, intrinsics, depth_scale, max_gap, every, segment, track, out, out_bag, rerun)
        recognize_bag(options, model, unknown_below, answer_by)
        return
    of_bags: dict[str, object] = {
        "color_topic": color_topic,
        "depth_topic": depth_topic,
        "camera_topic": camera_topic,
        "out_bag": out_bag,
    }
    of_bags |= {"max_gap": max_gap if max_gap != DEFAULT_MAX_GAP else None, "every": every if every > 1 else None}
    for name, value in of_bags.items():
        if value is not None:
            raise InputError(f"{name} is {value}; it belongs to --bag")
    if names is not None and coco is None and bop is None:
        raise InputError(f"names is {names}; it belongs to --coco and --bop")
    if segment is not None and labels is not None:
        raise InputError(f"labels is {labels} and segment is {segment}; give one of them")
    if poses is not None and not track:
        raise InputError(f"poses is {poses}; it belongs to --track")
    pool = worker_pool(workers, engine, address)
    if pool is not None and (track or not frames):
        reason = "--track, which takes the frames in turn" if track else "one frame"
        raise InputError(
            f"workers is {workers} and engine is {engine}; they are of no use for {reason}: leave them out"
        )
    files = {"color": color, "depth": depth, "labels": labels, "intrinsics": intrinsics}
    sources = _sources(frames, files, depth_scale, segment)
    of_frames = None if poses is None else read_poses(poses, [source.name for source in sources])
    if out is not None:
        check_output_directory(out, resumable={s.name.split("/")[0] for s in sources} if frames else RESULT_FILES)
        remove_leftovers(out)
    rerun_file = None if rerun is None else RerunFile(rerun)
    numbers = None if names is None else read_object_names(names)
    arguments = RecognizerArguments(model, unknown_below, answer_by)
    recognizer = arguments.load()
    tables = ResultTables([source.name for source in sources], recognizer.classes, numbers)
    failed = []
    if pool is not None:
        answers = recognize_frames_in_pool(arguments, sources, pool)
    else:
        answers = track_frames(recognizer, sources, of_frames) if track else recognize_frames(recognizer, sources)
    for answer in answers if rerun_file is None else _written(answers, rerun_file):
        if answer.error is not None or answer.frame is None:
            failed.append(answer.name)
            if not frames:
                raise InputError(str(answer.error))
            print(f"failed: {answer.name}: {answer.error}", file=sys.stderr)
        if as_json:
            print(json.dumps(answer.as_json()), flush=True)
        if answer.frame is None:
            continue
        if not as_json:
            _print_table(answer.name if frames else None, answer.recognitions)
        tables.add(answer)
        if out is not None:
            write_recognitions(out / answer.name if frames else out, answer.frame, answer.recognitions)
    tables.write(coco, bop)
    if not as_json:
        for written in filter(None, (out, coco, bop, rerun)):
            console.print(f"written to {written}")
    if tables.n_without_number and (coco or bop):
        print(f"{tables.n_without_number} instances have a name that {names} does not number", file=sys.stderr)
    if failed:
        listed = ", ".join(failed[:MAX_LISTED]) + (", ..." if len(failed) > MAX_LISTED else "")
        raise InputError(f"{len(failed)} of {len(sources)} frames could not be recognized: {listed}; see above")


def _sources(
    frames: list[Path] | None, files: dict[str, Path | None], depth_scale: float | None, segment: str | None
) -> list["FrameSource"]:
    """Return the frames that are given as folders, or the one that is given by its files."""
    import functools

    from thor2_jax.segmentation.segmenters import load_segmenter
    from training.readers.frame_files import FrameFiles, FrameSource, find_frames, segmented_source

    given = [name for name, path in files.items() if path is not None]
    if bool(frames) == bool(given):
        raise InputError("give either FRAME... or --color, --depth, --labels and --intrinsics")
    if frames:
        sources = find_frames(frames, depth_scale)
    else:
        missing = [name for name in files if files[name] is None and (name != "labels" or segment is None)]
        if missing:
            raise InputError(
                f"{', '.join(f'--{name}' for name in missing)} is missing; one frame needs {', '.join(files)}, or "
                "--segment in place of labels"
            )
        color, depth, labels, intrinsics = files.values()
        assert color and depth and intrinsics
        one = FrameFiles(color, depth, labels, intrinsics)
        sources = [FrameSource(color.stem, functools.partial(one.read, depth_scale))]
    if segment is None:
        return sources
    segmenter = load_segmenter(segment)
    return [segmented_source(source, segmenter) for source in sources]


def _written(answers: Iterator["FrameAnswer"], file: "RerunFile") -> Iterator["FrameAnswer"]:
    """Pass answers on, and write each to a file for the Rerun viewer."""
    from thor2_jax.recordings.detections import detections_of

    with file:
        for answer in answers:
            if answer.frame is not None:
                file.write(answer.frame, detections_of(answer.frame, answer.recognitions), name=answer.name)
            yield answer


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
