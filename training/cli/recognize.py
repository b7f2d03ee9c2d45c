"""`thor2 recognize`: recognize the instances of frames."""

import contextlib
import dataclasses
import functools
import itertools
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters, first_names
from training.cli import options
from training.cli.app import Table, app, console, finish, print_note

if TYPE_CHECKING:
    from thor2_jax.model.recognition import Recognition
    from training.frame_recognition import FrameAnswer


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutputOptions:
    """Options of the files for the answers."""

    out: Annotated[
        Path | None, typer.Option(help="Directory for recognition.json and overlay.png; OUT/<frame> for each FRAME.")
    ] = None
    coco: Annotated[Path | None, typer.Option(metavar="FILE", help="Write COCO results (JSON with masks).")] = None
    bop: Annotated[Path | None, typer.Option(metavar="FILE", help="Write BOP results (CSV, without poses).")] = None
    names: Annotated[
        Path | None, typer.Option(help="YAML or JSON table for --coco and --bop: number -> name of the object.")
    ] = None
    rerun: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write an .rrd file for the Rerun viewer (extra rerun).")
    ] = None
    out_bag: Annotated[
        Path | None, options.recording_option(help="Write detections: MCAP (.mcap), or directory of a ROS 2 bag.")
    ] = None


class _Answers:
    """The answers as they are printed and written; unusable files are refused before any frame is recognized.

    Attributes:
        failures: the `segmentation_failure` of each recognized frame.
        n_frames: number of frames so far, with those that could not be recognized.
    """

    def __init__(self, given: OutputOptions, frames: Sequence[str], *, several: bool, as_json: bool) -> None:
        """Check the paths.

        Args:
            given: the paths.
            frames: name of each frame; empty for a recording, whose frames are not known yet.
            several: whether there may be several frames: each has a directory of its name in `given.out`, and one that
                fails does not stop the others.
            as_json: whether the answers are printed as JSON instead of tables.
        """
        from thor2_jax.files import check_output_directory, check_output_file
        from thor2_jax.model import result_files
        from thor2_jax.recordings.detection_files import DetectionBag, RerunFile
        from training.readers.bop import read_object_names

        self._given, self._frames, self._several, self._as_json = given, frames, several, as_json
        self._failed: list[str] = []
        self.failures: list[str] = []
        self._has_unknown, self.n_frames = False, 0
        if given.out is not None:
            resumable = {name.split("/")[0] for name in frames} if several else {*result_files.RESULT_FILES}
            resumable |= {path.name for path in (given.coco, given.bop, given.rerun, given.out_bag) if path}
            check_output_directory(given.out, resumable=resumable)
            for name in frames if several else [""]:
                result_files.check_no_foreign_results(given.out / name)
        for (name, path), (other, same) in itertools.combinations(options.given_values(given).items(), 2):
            if path.absolute().is_relative_to(same.absolute()):  # the bag could not be moved to its place at the end
                raise InputError(f"{name} is {path} and {other} is {same}; expected {name} outside of that path")
        self._bag = None if given.out_bag is None else DetectionBag(given.out_bag)
        self._rerun = None if given.rerun is None else RerunFile(given.rerun)
        self._numbers = None if given.names is None else read_object_names(given.names)
        check_output_file("coco", given.coco, result_files.is_coco_file)
        check_output_file("bop", given.bop, result_files.is_bop_file)

    def write(self, answers: Iterable["FrameAnswer"], classes: Sequence[str]) -> None:
        """Print and write all answers, those before an interrupt, too; an error of a recording says where they are."""
        from thor2_jax.model.result_files import ResultTables

        self._tables = ResultTables(self._frames, classes, self._numbers)
        try:
            with self._bag or contextlib.nullcontext(), self._rerun or contextlib.nullcontext():
                for answer in answers:
                    self._add(answer)
        except InputError as error:
            if self._frames or not self.failures:
                raise
            place = f", written to {self._written}" if self._written else ""
            raise InputError(f"{error}; frames recognized before: {len(self.failures)}{place}") from None
        finally:
            if self.failures or self._failed:
                self._tables.write(self._given.coco, self._given.bop)

    def _add(self, answer: "FrameAnswer") -> None:
        from thor2_jax.model.result_files import RESULT_FILES, write_recognitions

        frame, place, out = answer.frame, answer.recorded, self._given.out
        if out is not None and self._several:
            out = out / answer.name
        if frame is None and out is not None:  # answers of an earlier call would look like new ones
            with contextlib.suppress(OSError):  # There is none, or the directory has other files.
                for file in reversed(RESULT_FILES):  # the first one shows that this command has written them
                    (out / file).unlink(missing_ok=True)
                if self._several:
                    out.rmdir()
        if frame is None and not self._several:
            raise InputError(str(answer.error))
        self.n_frames += 1
        if self._as_json:
            print(json.dumps(answer.as_json()), flush=True)
        if frame is None:
            self._failed.append(answer.name)
            print_note(f"failed: {answer.name}: {answer.error}")
            return
        self.failures.append(answer.segmentation_failure)
        self._has_unknown |= any(each.name is None for each in answer.recognitions)
        if not self._as_json:
            _print_table(answer.name if self._several else None, answer.recognitions)
        if self._given.coco or self._given.bop:
            self._tables.add(answer.name, frame, answer.detections, answer.seconds)
        if out is not None:
            write_recognitions(out, frame, answer.recognitions)
        if self._bag is not None and place is not None:
            self._bag.write(frame, answer.detections, stamp=place.stamp, frame_id=place.frame_id)
        if self._rerun is not None:
            self._rerun.write(frame, answer.detections, name=answer.name, stamp=None if place is None else place.stamp)

    @property
    def _written(self) -> str:
        """The paths that exist now, separated by commas."""
        given = self._given
        paths = given.out, given.out_bag, given.coco, given.bop, given.rerun
        return ", ".join(str(path) for path in paths if path and path.exists())

    def summarize(self, known: str, *command: str, **options: object) -> None:
        """Print where the answers are, `known` if an object is unknown, and the next command; refuse failed frames."""
        notes = sys.stderr if self._as_json else None
        if self._has_unknown:
            print(escape_characters(known), file=notes)
        if self.failures or not self._failed:
            result = f"written to {self._written}" if self._written else f"frames recognized: {len(self.failures)}"
            finish(result, "see why", *command, file=notes, **options)
        if self._tables.n_without_number:
            print_note(f"instances whose name has no number in {self._given.names}: {self._tables.n_without_number}")
        if self._failed:
            failed = f"{len(self._failed)} of {self.n_frames} frames could not be recognized"
            raise InputError(f"{failed}: {first_names(self._failed)}; see above")


@app.command()
@options.grouped_options
def recognize(
    *,
    model: options.ModelOption,
    given: options.FrameOptions,
    processes: options.WorkerOptions,
    segment: options.SegmentOption = None,
    unknown_below: options.UnknownOption = None,
    answer_by: options.AnswerByOption = None,
    track: Annotated[
        bool, typer.Option("--track", help="The frames are a sequence: follow the objects and fuse their answers.")
    ] = False,
    poses: Annotated[
        Path | None, typer.Option(help="JSON of camera poses for --track: frame -> 4 x 4 matrix, camera to world.")
    ] = None,
    outputs: OutputOptions,
    as_json: Annotated[bool, typer.Option("--json", help="Print one line of JSON for each frame.")] = False,
) -> None:
    """Recognize every instance of RGB-D frames.

    A frame that cannot be recognized does not stop the others; the command then ends with exit code 2. With --track,
    the frames are a sequence of one camera, in the order of their names, and an object has one name in all frames.
    """
    from thor2_jax.frames.frames import RecordedFrame
    from thor2_jax.segmentation.segmenters import TABLE
    from thor2_jax.tracking.viewpoints import read_poses
    from training.frame_recognition import RecognizerArguments, recognize_frames, track_frames
    from training.readers.frames import FrameSource, segmented_source

    given.check()
    frames, recording, table = given.frames, given.bag, {"coco": outputs.coco, "bop": outputs.bop}
    options.check_alone("bag", recording, names=outputs.names, **table, poses=poses, **options.given_values(processes))
    options.check_belongs("--bag", recording, out_bag=outputs.out_bag)
    options.check_belongs("--coco and --bop", any(table.values()), names=outputs.names)
    options.check_belongs("--track", track, poses=poses)
    if (pool := processes.pool()) is not None and (track or not frames):
        reason = "--track, which takes the frames in turn" if track else "one frame"
        raise InputError(
            f"workers is {processes.workers} and engine is {processes.engine}, of no use for {reason}; leave them out"
        )
    arguments = RecognizerArguments(model, unknown_below, answer_by)
    load = functools.cache(arguments.load)
    by_model = (lambda frame: load().segment(frame)) if pool is None else arguments.segment
    if recording is None:
        bag, sources = None, given.sources(segment, by_model)
    else:
        segmenter = options.find_segmenter(segment or TABLE, by_model)
        bag, sources = given.open_bag(), []
    names = [source.name for source in sources]
    frame_poses = None if poses is None else read_poses(poses, names)
    results = _Answers(outputs, names, several=bool(frames or recording), as_json=as_json or recording is not None)
    segmented: Iterable[FrameSource | RecordedFrame] = sources
    with contextlib.ExitStack() as stack:
        if bag is not None:
            for note in stack.enter_context(bag).notes:
                print_note(f"note: {note}")
            recorded = itertools.islice(bag.frames(), 0, None, given.every)
            segmented = (dataclasses.replace(each, read=segmented_source(each, segmenter).read) for each in recorded)
        recognizer = load()
        if track and bag is None:
            answers = track_frames(recognizer, sources, frame_poses)
        elif pool is not None:
            answers = stack.enter_context(contextlib.closing(pool(arguments.answer, sources)))
        else:
            answers = recognize_frames(recognizer.track().update if track else recognizer.recognize, segmented)
        results.write(answers, recognizer.classes)
    if bag is not None and bag.counts.color > bag.counts.pairs:
        unpaired = f"{bag.counts.color - bag.counts.pairs} of {bag.counts.color} images of {bag.topics.color}"
        print_note(f"{unpaired} have no depth within {given.max_gap:g} s")
    unused: dict[str | None, Any] = {"gallery": {"trained": ()}, "classifiers": {"objects": {}}}
    answering = dataclasses.replace(recognizer.gallery, **unused.get(recognizer.model.answers_by(), {}))
    frames_given = given.arguments(len(names) or results.n_frames)
    same = {"segment": segment, **vars(arguments)}
    results.summarize(f"{model} recognizes {answering.summary}", "explain", *frames_given, **same, out="why")
    if (segment or recording) and results.failures and all(results.failures):
        raise InputError(results.failures[0])


NOTE_WIDTH = 120
"""Columns of a terminal from which on notes are a column of the table; in narrower ones, they are below it."""


def _print_table(frame: str | None, recognitions: Sequence["Recognition"]) -> None:
    tracked = any(hasattr(r, "track") for r in recognitions)
    beside = console.width >= NOTE_WIDTH
    titles = "label", "name", "confidence", "classifier", "occluded", "points"
    table = Table(*["track"] * tracked, *titles, *["note"] * beside, folded=("name", "note"))
    below: dict[str, list[str]] = {}
    for r in recognitions:
        confidence = "" if r.confidence is None else f"{r.confidence:.3f}"
        overflow = [f"overflow: {r.overflow}"] * bool(r.overflow)
        note = r.reason or ", ".join(["outlier filter relaxed"] * r.kept_by_fallback + overflow)
        name = escape_characters(r.name or "unrecognized")
        row = str(r.label), name, confidence, r.classifier or "", "yes" if r.occluded else "no", str(r.points_used)
        table.add_row(*[str(getattr(r, "track", "") or "")] * tracked, *row, *[note] * beside)
        if note and not beside:
            below.setdefault(note, []).append(str(r.label))
    if frame is not None:
        console.print(f"{frame}:")
    console.print(table if recognitions else "no instances: all pixels are background")
    for note, labels in below.items():
        console.print(f"{', '.join(labels)}: {note}")
