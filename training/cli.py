"""The command line, `thor2`. Imported by nobody; everything it does is a call into the packages.

Bad input ends with one line on standard error and exit code 2; nothing half-written stays behind.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from thor2_jax.errors import InputError

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Name the objects on a cluttered table from an RGB-D frame, trained on synthetic views (THOR2 in JAX).",
)
evaluate_app = typer.Typer(no_args_is_help=True, help="Accuracy of a trained run on a labelled dataset.")
app.add_typer(evaluate_app, name="evaluate")
# Not on a terminal there is no width to fit, and rich would cut tables at 80 columns.
console = Console(width=None if sys.stdout.isatty() else 160)

ModelOption = Annotated[Path, typer.Option("--model", help="Run folder of a trained model.")]


def _bar() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
    )


def _new_folder(path: Path) -> None:
    """Refuse a folder that holds something already, before any work is done."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"out: {path} exists already and is not an empty folder")


@app.command()
def colornet(out: Annotated[Path, typer.Option(help="Folder for network.npz and two pictures.")]) -> None:
    """Build the colour network from scratch and draw it."""
    import colornet as colornet_package
    from colornet.draw import draw_network, draw_similarity

    _new_folder(out)
    network = colornet_package.build()
    out.mkdir(parents=True, exist_ok=True)
    network.save(out / "network.npz")
    draw_network(network, out / "network.png")
    draw_similarity(network, out / "similarity.png")
    same = network.fingerprint == colornet_package.load_default().fingerprint
    console.print(
        f"{network.n_raw_nodes} raw nodes, {network.n_regions} regions, {len(network.edges)} edges; "
        f"{'equal to' if same else 'DIFFERENT from'} the packaged network; written to {out}"
    )


@app.command()
def render(
    meshes: Annotated[Path, typer.Option(help="Folder of meshes (GLB, OBJ, PLY), one a file or sub-folder.")],
    out: Annotated[Path, typer.Option(help="New folder for the views.")],
    names: Annotated[Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all.")] = None,
    azimuth_step: Annotated[float, typer.Option(help="Degrees between cameras around the object.")] = 5.0,
    polar_step: Annotated[float, typer.Option(help="Degrees between cameras from pole to pole.")] = 5.0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render.")] = 2,
) -> None:
    """Render views of meshes to a folder of clouds that `train --dataset` reads."""
    from training.meshes import find_meshes, read_names
    from training.view_files import render_to_folder

    _new_folder(out)
    found = find_meshes(meshes, read_names(names) if names else None)
    with _bar() as bar:
        task = bar.add_task("render", total=None, note="")
        render_to_folder(found, out, azimuth_step, polar_step, workers, _advance(bar, task))


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="New run folder.")],
    meshes: Annotated[Path | None, typer.Option(help="Folder of meshes (GLB, OBJ, PLY) to render.")] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder that `thor2 render` wrote, instead of --meshes.")] = None,
    names: Annotated[Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all.")] = None,
    azimuth_step: Annotated[float, typer.Option(help="Degrees between cameras around the object.")] = 5.0,
    polar_step: Annotated[float, typer.Option(help="Degrees between cameras from pole to pole.")] = 5.0,
    classifiers: Annotated[str, typer.Option(help="Comma-separated: tops, tops2, ce.")] = "tops,tops2,ce",
    epochs: Annotated[int, typer.Option(help="Half at a learning rate of 1e-2, half at 1e-3.")] = 100,
    batch_size: Annotated[int, typer.Option(help="Samples a step.")] = 128,
    seed: Annotated[int, typer.Option(help="Of weights, order and dropout.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render.")] = 2,
) -> None:
    """Train a recognizer on synthetic views of meshes."""
    from training.fit import FitOptions
    from training.meshes import find_meshes, read_names
    from training.train import train_run
    from training.view_files import read_view_folder, render_views

    _new_folder(out)
    options = FitOptions(epochs=epochs, batch_size=batch_size, seed=seed)
    features = [name.strip() for name in classifiers.split(",")]
    if (meshes is None) == (dataset is None):
        raise InputError("give exactly one of --meshes and --dataset")
    if meshes is not None:
        found = find_meshes(meshes, read_names(names) if names else None)
        with _bar() as bar:
            task = bar.add_task("render", total=None, note="")
            views = render_views(found, azimuth_step, polar_step, workers, _advance(bar, task))
    else:
        assert dataset is not None
        views = read_view_folder(dataset)
    with _bar() as bar:
        train_run(views, out, features, options, _stages(bar))
    console.print(f"run written to {out}")


def _advance(bar: Progress, task: Any) -> Callable[[int, int], None]:
    return lambda done, total: bar.update(task, completed=done, total=total)


def _stages(bar: Progress) -> Callable[[str, int, int, str], None]:
    """A callback (stage, done, total, note) that shows one bar a stage."""
    tasks: dict[str, Any] = {}

    def show(stage: str, done: int, total: int, note: str) -> None:
        if stage not in tasks:
            tasks[stage] = bar.add_task(stage, total=total, note=note)
        bar.update(tasks[stage], completed=done, total=total, note=note)

    return show


@app.command()
def recognize(
    model: ModelOption,
    color: Annotated[Path, typer.Option(help="Colour image, PNG or JPEG.")],
    depth: Annotated[Path, typer.Option(help="Depth image, 16-bit PNG.")],
    labels: Annotated[Path, typer.Option(help="Instance labels, PNG; 0 is background.")],
    intrinsics: Annotated[Path, typer.Option(help="JSON with fx, fy, cx, cy (pixels), optionally depth_scale.")],
    out: Annotated[Path | None, typer.Option(help="Folder for recognition.json and overlay.png.")] = None,
) -> None:
    """Name every instance of one RGB-D frame."""
    import dataclasses

    from thor2_jax.files import write_text
    from thor2_jax.frames import read_frame
    from thor2_jax.overlay import draw_overlay
    from thor2_jax.recognizer import Recognizer

    frame = read_frame(color=color, depth=depth, labels=labels, intrinsics=intrinsics)
    answers = Recognizer.load(model).recognize(frame)
    table = Table("label", "name", "confidence", "classifier", "occluded", "points", "overflow", "note")
    for a in answers:
        sure = "" if a.confidence is None else f"{a.confidence:.3f}"
        note = a.reason or ("outlier filter relaxed" if a.kept_by_fallback else "")
        name = a.name or "unrecognized"
        hidden = "yes" if a.occluded else "no"
        table.add_row(str(a.label), name, sure, a.classifier or "", hidden, str(a.points_used), str(a.overflow), note)
    console.print(table)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        rows = [dataclasses.asdict(a) for a in answers]
        draw_overlay(frame.color, frame.labels, answers, out / "overlay.png")
        write_text(out / "recognition.json", json.dumps(rows, indent=1) + "\n")
        console.print(f"written to {out}")


def _evaluate(frames: Any, model: Path, out: Path | None) -> None:
    from thor2_jax.recognizer import Recognizer
    from training.evaluate import evaluate, joinings, summarize, write_report

    recognizer = Recognizer.load(model)
    with _bar() as bar:
        task = bar.add_task("evaluate", total=len(frames), note="")
        instances = evaluate(recognizer, frames, lambda name: bar.update(task, advance=1, note=name))
    names = list(joinings(recognizer.run.classifiers))
    summary = summarize(instances, names)
    table = Table("", "", "instances", *names)
    for attribute, values in summary["accuracy"].items():
        for value, row in values.items():
            table.add_row(
                attribute, value, str(row["instances"]), *("" if row[n] is None else f"{row[n]:.3f}" for n in names)
            )
    console.print(table)
    console.print(
        f"{summary['scored']} instances scored, {summary['unanswered']} of them could not be described (counted as "
        f"wrong); {summary['not_scored']} are no class of this run"
    )
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_report(out / "evaluation.json", summary, instances)
        console.print(f"written to {out}")


DatasetArgument = Annotated[Path, typer.Argument(help="The dataset's folder.")]
ReportOption = Annotated[Path | None, typer.Option("--out", help="Folder for evaluation.json.")]


@evaluate_app.command()
def uwis(dataset: DatasetArgument, model: ModelOption, out: ReportOption = None) -> None:
    """UW-IS Occluded: <video>/images/<id>_{rgb,depth,labels}.png and <id>_poses.yaml."""
    from training.readers.uwis import UWISOccluded

    _evaluate(UWISOccluded(dataset), model, out)


@evaluate_app.command()
def frames(dataset: DatasetArgument, model: ModelOption, out: ReportOption = None) -> None:
    """Single frames: <frame>/{color,depth,mask}.png, intrinsics.json, labels.json."""
    from training.readers.frames import FrameFolder

    _evaluate(FrameFolder(dataset), model, out)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="New folder for the report, its pictures and the trained run.")],
    seed: Annotated[int, typer.Option(help="Of weights and scenes.")] = 0,
) -> None:
    """Train on built-in objects, recognize cluttered scenes of them, write a report. No download; a few minutes."""
    from training.demo import run_demo

    _new_folder(out)
    with _bar() as bar:
        figures = run_demo(out, seed, _stages(bar))
    table = Table("", *figures.names)
    for part, values in figures.accuracy.items():
        table.add_row(part, *(f"{v:.3f}" for v in values))
    console.print(table)
    console.print(f"report: {out / 'report.html'}")


def main() -> None:
    """Entry point of the console script."""
    try:
        app(standalone_mode=True)
    except InputError as error:
        _fail(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _fail(f"{where}{error.strerror or error}")


def _fail(message: str) -> None:
    print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
    raise SystemExit(2)


if __name__ == "__main__":
    main()
