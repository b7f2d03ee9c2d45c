"""`thor2 evaluate`: measure the accuracy of trained runs, one command per dataset format."""

import functools
import hashlib
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from training.cli.app import QuietOption, app, console, show_help
from training.cli.progress import show_progress
from training.cli.workers import AddressOption, EngineOption, WorkersOption, worker_pool

if TYPE_CHECKING:
    from training.storage.workers import WorkerPool

evaluate_app = typer.Typer(
    callback=show_help, invoke_without_command=True, help="Measure the accuracy of trained runs on a labelled dataset."
)
app.add_typer(evaluate_app, name="evaluate")

MAX_LISTED = 10
"""Labels that the summary lists."""

DatasetArgument = Annotated[Path, typer.Argument(help="Directory of the dataset.")]
ModelsOption = Annotated[
    list[Path], typer.Option("--model", help="Run directory, or the directory of a training with several folds.")
]
MoreModels = Annotated[list[Path] | None, typer.Argument(metavar="[RUN]...", help="Further run directories.")]
ReportOption = Annotated[
    Path | None,
    typer.Option("--out", help="Directory for report.html and report.json; an interrupted evaluation resumes."),
]


@evaluate_app.command()
def uwis(
    dataset: DatasetArgument,
    model: ModelsOption,
    runs: MoreModels = None,
    out: ReportOption = None,
    workers: WorkersOption = 1,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
) -> None:
    """UW-IS Occluded: <video>/images/<id>_{rgb,depth,labels}.png and <id>_poses.yaml."""
    from training.readers.uwis import UWISOccluded

    pool = worker_pool(workers, engine, address)
    _evaluate("uwis", UWISOccluded(dataset), dataset, [*model, *(runs or [])], out, pool, quiet)


@evaluate_app.command()
def frames(
    dataset: DatasetArgument,
    model: ModelsOption,
    runs: MoreModels = None,
    out: ReportOption = None,
    workers: WorkersOption = 1,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
) -> None:
    """Single frames: <frame>/{color,depth,mask}.png, intrinsics.json, labels.json."""
    from training.readers.frames import FrameFolder

    pool = worker_pool(workers, engine, address)
    _evaluate("frames", FrameFolder(dataset), dataset, [*model, *(runs or [])], out, pool, quiet)


@evaluate_app.command()
def ocid(
    dataset: DatasetArgument,
    model: ModelsOption,
    names: Annotated[
        Path,
        typer.Option(help="Table: sequence -> object names in order of placement; or a table of OCID-VLG."),
    ],
    runs: MoreModels = None,
    per_sequence: Annotated[
        bool, typer.Option(help="RUN holds one run per sequence, as written by `train --sequences`.")
    ] = False,
    out: ReportOption = None,
    workers: WorkersOption = 1,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
) -> None:
    """OCID, subset YCB10: {table,floor}/{bottom,top}/<type>/<sequence>/{rgb,depth,label,pcd}."""
    from training.readers.ocid import OCID

    pool = worker_pool(workers, engine, address)
    _evaluate("ocid", OCID(dataset, names), dataset, [*model, *(runs or [])], out, pool, quiet, per_sequence, names)


@evaluate_app.command()
def bop(
    dataset: DatasetArgument,
    model: ModelsOption,
    names: Annotated[Path | None, typer.Option(help="YAML or JSON table: obj_id -> name. Default: obj_000001.")] = None,
    runs: MoreModels = None,
    out: ReportOption = None,
    workers: WorkersOption = 1,
    engine: EngineOption = "local",
    address: AddressOption = None,
    quiet: QuietOption = False,
) -> None:
    """BOP format (YCB-Video and others): <scene>/{rgb,depth,mask_visib}, scene_camera.json and scene_gt.json."""
    from training.readers.bop import BOP

    pool = worker_pool(workers, engine, address)
    _evaluate("bop", BOP(dataset, names), dataset, [*model, *(runs or [])], out, pool, quiet, names=names)


def _evaluate(
    kind: str,
    frames: Any,
    dataset: Path,
    models: list[Path],
    out: Path | None,
    pool: "WorkerPool | None",
    quiet: bool,
    per_sequence: bool = False,
    names: Path | None = None,
) -> None:
    from training.evaluation.answering import RunArguments, answer_frames_in_pool
    from training.evaluation.job import evaluate_dataset

    arguments = RunArguments(tuple(models), per_sequence)
    description = {"kind": kind, "path": str(dataset.resolve())}
    if names:
        description["names"] = hashlib.sha256(names.read_bytes()).hexdigest()
    finished = out is not None and (out / "report.json").is_file()
    with tempfile.TemporaryDirectory() as temporary, show_progress(quiet) as progress:
        runs = arguments.load(frames)
        answering = functools.partial(answer_frames_in_pool, arguments, frames, pool) if pool else None
        report = evaluate_dataset(runs, frames, description, out or Path(temporary) / "report", progress, answering)
    _print_report(report)
    if out is not None:
        console.print(f"report: {out / 'report.html'}{' (was finished: nothing was recomputed)' if finished else ''}")


def _print_report(report: Mapping[str, Any]) -> None:
    from training.evaluation.page import accuracy_table, comparison_table, comparison_text, comparison_title

    counts, speed = report["instances"], report["speed"]
    if report["fusions"]:
        shown = Table("", "instances", *report["fusions"])
        for table in report["accuracy"][report["rule"]]:
            header, rows = accuracy_table(table, report["fusions"])
            shown.add_section()
            if header[0]:
                shown.add_row(f"by {header[0]}", style="bold")
            for row in rows:
                shown.add_row(*row)
        console.print(shown)
        for table in report["published_tables"]:
            header, rows = comparison_table(table, report["main"])
            shown = Table(*header, title=comparison_title(table))
            for row in rows:
                shown.add_row(*row)
            console.print(shown)
            console.print(comparison_text(table))
    console.print(
        f"{counts['scored']} instances scored, {sum(counts['not_described'].values())} of them could not be described "
        f"(counted as incorrect); {sum(counts['no_class'].values())} are of no class of the runs"
    )
    if report["no_pixels"]:
        missing = [f"{entry['label']} of frame {entry['frame']}" for entry in report["no_pixels"]]
        more = ", ..." if len(missing) > MAX_LISTED else ""
        console.print(f"labels without pixels in the label image: {', '.join(missing[:MAX_LISTED])}{more}")
    if speed["frames_per_second"]:
        console.print(
            f"{speed['frames']} frames, {speed['frames_per_second']:.2f} a second with compilation; "
            f"median {speed['median_seconds']:.2f} s a frame"
        )
