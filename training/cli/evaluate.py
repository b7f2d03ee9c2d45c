"""`thor2 evaluate`: measure the accuracy of trained runs, one command per dataset format."""

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.cells import cell_len

from thor2_jax.printable import first_names
from training.cli import options
from training.cli.app import Table, app, console, finish, show_help, show_progress

evaluate_app = typer.Typer(
    callback=show_help, invoke_without_command=True, help="Measure the accuracy of trained runs on a labelled dataset."
)
app.add_typer(evaluate_app, name="evaluate")

DatasetArgument = Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of the dataset.")]


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationOptions(options.WorkerOptions):
    """The models to evaluate, and the directory of the report."""

    model: Annotated[list[Path], typer.Option(help="Run directory, or the directory of a training with several folds.")]
    out: Annotated[
        Path | None, typer.Option(help="Directory for report.html and report.json; an interrupted evaluation resumes.")
    ] = None
    quiet: options.QuietOption = False
    runs: Annotated[list[Path] | None, typer.Argument(metavar="RUN", help="Further run directories.")] = None


@evaluate_app.command()
@options.grouped_options
def uwis(dataset: DatasetArgument, job: EvaluationOptions) -> None:
    """UW-IS Occluded: <video>/images/<id>_{rgb,depth,labels}.png and <id>_poses.yaml."""
    from training.readers.uwis import UWISOccluded

    _evaluate("uwis", UWISOccluded(dataset), dataset, job)


@evaluate_app.command()
@functools.partial(options.grouped_options, without=(*options.RECORDING_OPTIONS, "runs"))
def frames(given: options.FrameOptions, job: EvaluationOptions) -> None:
    """Frames with named objects: <frame>/{color,depth,mask}.png, intrinsics.json, labels.json.

    A FRAME that is a run directory, or the directory of a training with several folds, is used as a further model.
    Recordings cannot be evaluated, since they do not contain the names of their objects.
    """
    from thor2_jax.model.run_record import run_directories
    from training.readers.frames import FrameFolder

    paths = given.frames or ()
    runs = [path for path in paths if run_directories(path)]
    given = dataclasses.replace(given, frames=[path for path in paths if path not in runs])
    options.check_belongs("--labels", given.labels, color=given.depth and given.color)
    folder = FrameFolder(given.sources(masks=False))
    files = filter(None, [given.color, given.depth, given.labels, given.intrinsics])
    dataset = ", ".join(str(path.resolve()) for path in given.frames or files)
    if folder.note:
        console.print(f"skipped: {folder.note}")
    _evaluate("frames", folder, dataset, dataclasses.replace(job, runs=runs), given=given)


@evaluate_app.command()
@options.grouped_options
def ocid(
    dataset: DatasetArgument,
    job: EvaluationOptions,
    names: Annotated[
        Path, typer.Option(help="Table: sequence -> object names in order of placement; or a table of OCID-VLG.")
    ],
    per_sequence: Annotated[
        bool, typer.Option("--per-sequence", help="RUN holds one run per sequence (`train --sequences`).")
    ] = False,
) -> None:
    """OCID, subset YCB10: {table,floor}/{bottom,top}/<type>/<sequence>/{rgb,depth,label,pcd}."""
    from training.readers.ocid import OCID

    _evaluate("ocid", OCID(dataset, names), dataset, job, per_sequence, names)


@evaluate_app.command()
@options.grouped_options
def bop(
    dataset: DatasetArgument,
    job: EvaluationOptions,
    names: Annotated[Path | None, typer.Option(help="YAML or JSON table: obj_id -> name. Default: obj_000001.")] = None,
) -> None:
    """BOP format (YCB-Video and others): <scene>/{rgb,depth,mask_visib}, scene_camera.json and scene_gt.json."""
    from training.readers.bop import BOP

    _evaluate("bop", BOP(dataset, names), dataset, job, names=names)


def _evaluate(
    kind: str,
    frames: Any,
    dataset: Path | str,
    job: EvaluationOptions,
    per_sequence: bool = False,
    names: Path | None = None,
    given: options.FrameOptions | None = None,
) -> None:
    from thor2_jax.files import file_digest
    from thor2_jax.model.run_record import RUN_FILE
    from training.evaluation.job import answer_frames_in_pool, evaluate_dataset, load_runs

    models, out, pool = (*job.model, *(job.runs or ())), job.out, job.pool()
    load = models, tuple(frames.identifiers) if per_sequence else None
    description = {"kind": kind, "path": dataset if isinstance(dataset, str) else str(dataset.resolve())}
    if names:
        description["names"] = file_digest(names)
    if given and given.depth_scale is not None:
        description["depth_scale"] = str(given.depth_scale)
    finished = out is not None and (out / "report.json").is_file()
    with tempfile.TemporaryDirectory() as temporary, show_progress(job.quiet) as progress:
        loaded = load_runs(*load)
        answering = functools.partial(answer_frames_in_pool, load, frames, pool) if pool else None
        report = evaluate_dataset(loaded, frames, description, out or Path(temporary) / "report", progress, answering)
    _print_report(report)
    result = "no report was written (--out)"
    if out is not None:
        result = f"report: {out / 'report.html'}{' (was finished: nothing was recomputed)' if finished else ''}"
    # A model may be a directory of folds or sequences; the command is for the first run in it.
    files = models[0].rglob(RUN_FILE)
    run = min(files, key=lambda path: (len(path.parts), path), default=models[0] / RUN_FILE).parent
    example: dict[str, Any] = next(iter(report["worst"]), {})
    if example and given and given.frames:
        files = frames.files(frames.identifiers.index(example["frame"]))
        given = dataclasses.replace(given, frames=[files[0].parent])
    explained = given.arguments(0 if example else len(frames)) if given else ["FRAME"]
    purpose = "explain a wrong answer" if example else "explain answers"
    finish(result, purpose, "explain", *explained, instance=example.get("label"), model=run, out="why")


def _print_report(report: Mapping[str, Any]) -> None:
    from training.evaluation import page

    counts, speed = report["instances"], report["speed"]
    overall, *others = (page.accuracy_table(table, report["fusions"]) for table in report["accuracy"][report["rule"]])
    header, rows = page.marked(overall, report["main"])
    for (group, *cells), more in others:
        rows = [*rows, [f"by {group}", *[""] * len(cells)], *more]
    _print_columns(*((header, rows) if others else page.upright((header, rows))), "accuracy without rejection")
    for table in report["published_tables"]:
        title, text, compared = page.comparison(table, report["main"])
        _print_columns(*page.marked(compared, report["main"]), title)
        console.print(text)
    console.print(
        f"instances scored: {counts['scored']}; {sum(counts['not_described'].values())} of them could not be described "
        f"(counted as incorrect); {sum(counts['no_class'].values())} are of no class of the runs"
    )
    if report["no_pixels"]:
        missing = [f"{entry['label']} of frame {entry['frame']}" for entry in report["no_pixels"]]
        console.print(f"labels without pixels in the label image: {first_names(missing)}")
    console.print(
        f"frames: {speed['frames']}, {speed['frames_per_second']:.2f} a second with compilation; "
        f"median {speed['median_seconds']:.2f} s a frame"
    )
    for text in page.answer_texts(report):
        console.print(text)


def _print_columns(header: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
    """Print a table; columns that do not fit the console follow in further tables with the same first column."""
    columns = list(zip(header, *rows, strict=True))
    widths = [max(map(cell_len, (*column[0].split(), *column[1:]))) + 3 for column in columns]
    start = 1
    while start < len(columns):
        n_fitting = sum(width <= console.width - 1 - widths[0] for width in itertools.accumulate(widths[start:]))
        end = start + max(n_fitting, 1)
        shown = Table(header[0], *header[start:end], title=title, folded=header[start:end] if n_fitting else None)
        for row in rows:
            if not row[1]:
                shown.add_section()
            shown.add_row(row[0], *row[start:end], style=None if row[1] else "bold")
        console.print(shown)
        start = end
