"""The command line, `thor2`. Imported by nobody; everything it does is a call into the packages.

Bad input ends with one line on standard error and exit code 2; nothing half-written stays behind.
"""

import hashlib
import json
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

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
evaluate_app = typer.Typer(no_args_is_help=True, help="Accuracy of trained runs on a labelled dataset.")
app.add_typer(evaluate_app, name="evaluate")
# Not on a terminal there is no width to fit, and rich would cut tables at 80 columns.
console = Console(width=None if sys.stdout.isatty() else 160)

EngineName = Literal["local", "ray"]
UnknownOption = Annotated[
    float, typer.Option("--unknown-below", help="Confidence that an answer needs to have a name (a report tells one).")
]
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


@app.command()
def colornet(out: Annotated[Path, typer.Option(help="Folder for network.npz and two pictures.")]) -> None:
    """Build the colour network from scratch and draw it."""
    import colornet as colornet_package
    from colornet.draw import draw_network, draw_similarity
    from thor2_jax.files import check_new

    check_new(out)
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
    out: Annotated[Path, typer.Option(help="Folder for the views: new, or one that this command has begun.")],
    names: Annotated[Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all.")] = None,
    azimuth_step: Annotated[float, typer.Option(help="Degrees between cameras around the object.")] = 5.0,
    polar_step: Annotated[float, typer.Option(help="Degrees between cameras from pole to pole.")] = 5.0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render; with Ray, tasks at a time.")] = 2,
    engine: Annotated[EngineName, typer.Option(help="This machine, or a Ray cluster (extra `cluster`).")] = "local",
    address: Annotated[str | None, typer.Option(help="Of the Ray cluster. Default: one on this machine.")] = None,
    illumination: Annotated[bool, typer.Option("--illumination", help="Varied copies: light and camera.")] = False,
    sensor: Annotated[bool, typer.Option("--sensor", help="Varied copies: noise and faults of depth.")] = False,
    occlusion: Annotated[bool, typer.Option("--occlusion", help="Varied copies: another object in front.")] = False,
    segmentation: Annotated[bool, typer.Option("--segmentation", help="Varied copies: inexact masks.")] = False,
    copies: Annotated[int, typer.Option(help="Varied copies of each view, if there are variations.")] = 2,
    seed: Annotated[int, typer.Option(help="Of the variations.")] = 0,
) -> None:
    """Render views of meshes to a dataset that `train --dataset` reads. Interrupted, it goes on when called again."""
    from training.augmentation import Illumination, Occlusion, Segmentation, Sensor, Variations
    from training.objects.meshes import find_meshes, read_names
    from training.storage.workers import local_workers, ray_workers
    from training.views.render_job import render_dataset

    if address is not None and engine != "ray":
        raise InputError(f"address is {address}; it goes with --engine ray")
    found = find_meshes(meshes, read_names(names) if names else None)
    pool = local_workers(workers) if engine == "local" else ray_workers(workers, address)
    variations = Variations(
        illumination=Illumination() if illumination else None,
        sensor=Sensor() if sensor else None,
        occlusion=Occlusion() if occlusion else None,
        segmentation=Segmentation() if segmentation else None,
        copies=copies,
    )
    with _bar() as bar:
        progress = _stage(bar, "render")
        dataset = render_dataset(found, out, azimuth_step, polar_step, pool, progress, variations or None, seed)
    console.print(
        f"{len(dataset)} views of {len(dataset.classes)} objects ({dataset.manifest.left_out} left out) in {out}"
    )


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="Run folder: new, or one that this command has begun.")],
    meshes: Annotated[Path | None, typer.Option(help="Folder of meshes (GLB, OBJ, PLY) to render.")] = None,
    dataset: Annotated[Path | None, typer.Option(help="Folder that `thor2 render` wrote, instead of --meshes.")] = None,
    names: Annotated[Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all.")] = None,
    paper: Annotated[bool, typer.Option(help="The paper's protocol.")] = False,
    azimuth_step: Annotated[
        float | None, typer.Option(help="Degrees between cameras around the object. (20; 5)")
    ] = None,
    polar_step: Annotated[float | None, typer.Option(help="Degrees between cameras from pole to pole. (15; 5)")] = None,
    classifiers: Annotated[str, typer.Option(help="Comma-separated: tops, tops2, ce.")] = "tops,tops2,ce",
    epochs: Annotated[int | None, typer.Option(help="Half at a learning rate of 1e-2, half at 1e-3. (24; 100)")] = None,
    batch_size: Annotated[int | None, typer.Option(help="Samples a step. (256; 128)")] = None,
    seed: Annotated[int, typer.Option(help="Of varied views, weights, order and dropout.")] = 0,
    folds: Annotated[int, typer.Option(min=1, help="More than 1: a model each, its own views held out.")] = 1,
    baselines: Annotated[str, typer.Option(help="Comma-separated: thor, forest, pointnet. To compare with.")] = "",
    leave_out: Annotated[str, typer.Option(help="Comma-separated: objects that are not trained.")] = "",
    sequences: Annotated[
        Path | None, typer.Option(help="YAML or JSON table: sequence -> its objects. A run for each, OUT/<sequence>.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render.")] = 2,
    coordinator: Annotated[str | None, typer.Option(help="HOST:PORT of process 0, if there are several.")] = None,
    processes: Annotated[int, typer.Option(min=1, help="Processes that train together.")] = 1,
    process: Annotated[int, typer.Option(min=0, help="Number of this one.")] = 0,
) -> None:
    """Train a recognizer on synthetic views of meshes. Interrupted, it goes on when called again.

    Of --meshes, each view is used as rendered and in two varied copies: under another light, partly hidden, with the
    errors of a depth camera and of a mask. A --dataset has the copies that it was rendered with. --paper trains as the
    paper does: on plain views only, more of them, each in four mirrors, for longer; its defaults stand second.

    With --baselines, a run that is finished gets those that it lacks. With --sequences, every sequence that lacks one
    gets a run of its objects alone (see `thor2 evaluate ocid --per-sequence`); the others must be of the same options.
    """
    import jax

    if (meshes is None) == (dataset is None):
        raise InputError("give exactly one of --meshes and --dataset")
    if sequences is not None and (dataset is None or leave_out):
        raise InputError(f"sequences is {sequences}; it goes with --dataset, and without --leave-out")
    if coordinator is not None:
        if meshes is not None:
            raise InputError("coordinator: several processes train from a --dataset that all of them can read")
        jax.distributed.initialize(coordinator, processes, process)
    from thor2_jax.recognition.classifier import check_features
    from training.baselines.job import check_baselines, train_baselines
    from training.fitting.fit import FitOptions
    from training.fitting.job import VIEWS, check_out, check_trained, is_finished, train_run
    from training.fitting.protocol import DEFAULT, PAPER
    from training.objects.meshes import find_meshes, read_names
    from training.storage.workers import local_workers
    from training.views.dataset import ViewDataset
    from training.views.left_out import WithoutClasses
    from training.views.render_job import render_dataset
    from training.views.sequences import sequence_sources
    from training.views.source import ViewSource

    compared = check_baselines(_listed(baselines))
    if sequences is None and not (compared and is_finished(out)):
        check_out(out)
    protocol = PAPER if paper else DEFAULT
    options = FitOptions(
        epochs=protocol.fit.epochs if epochs is None else epochs,
        batch_size=protocol.fit.batch_size if batch_size is None else batch_size,
        seed=seed,
    )
    features = check_features(_listed(classifiers), "classifiers")
    if meshes is not None:
        found = find_meshes(meshes, read_names(names) if names else None)
        steps = (
            protocol.azimuth_step if azimuth_step is None else azimuth_step,
            protocol.polar_step if polar_step is None else polar_step,
        )
        with _bar() as bar:
            progress = _stage(bar, "render")
            source: ViewSource = render_dataset(
                found, out / VIEWS, *steps, local_workers(workers), progress, protocol.variations, seed
            )
    else:
        assert dataset is not None
        source = ViewDataset.open(dataset)
    if leave_out:
        source = WithoutClasses(source, _listed(leave_out))
    parts = {out: source}
    if sequences is not None:
        parts = {out / sequence: views for sequence, views in sequence_sources(source, sequences).items()}
        for folder in filter(is_finished, parts):
            check_trained(parts[folder], folder, features, options, folds, protocol.mirrors)
    runs = {}
    for folder, views in parts.items():
        with _bar() as bar:
            show = _stages(bar)
            if not is_finished(folder):
                runs[folder] = train_run(views, folder, features, options, show, folds=folds, mirrors=protocol.mirrors)
            if compared and jax.process_index() == 0:
                train_baselines(folder, views, compared, show)
    if meshes is not None and jax.process_index() == 0:
        shutil.rmtree(out / VIEWS)
    for folder in parts:
        for run in runs.get(folder, []):
            for name, accuracy in run.record["held_out_accuracy"].items():
                console.print(f"fold {run.record['fold']}: {name} names {accuracy:.3f} of the views held out rightly")
        console.print(f"run written to {folder}")


def _listed(names: str) -> list[str]:
    return [name.strip() for name in names.split(",")] if names else []


def _stages(bar: Progress) -> Callable[[str, int, int, str], None]:
    """A callback (stage, done, total, note) that shows one bar a stage."""
    tasks: dict[str, Any] = {}

    def show(stage: str, done: int, total: int, note: str) -> None:
        if stage not in tasks:
            # Begun at what is done already: the time left is that of the rest.
            tasks[stage] = bar.add_task(stage, total=total, completed=done, note=note)
        bar.update(tasks[stage], completed=done, total=total, note=note)

    return show


def _stage(bar: Progress, stage: str) -> Callable[[int, int], None]:
    show = _stages(bar)
    return lambda done, total: show(stage, done, total, "")


@app.command()
def recognize(
    model: ModelOption,
    color: Annotated[Path, typer.Option(help="Colour image, PNG or JPEG.")],
    depth: Annotated[Path, typer.Option(help="Depth image, 16-bit PNG.")],
    labels: Annotated[Path, typer.Option(help="Instance labels, PNG; 0 is background.")],
    intrinsics: Annotated[Path, typer.Option(help="JSON with fx, fy, cx, cy (pixels), optionally depth_scale.")],
    unknown_below: UnknownOption = 0.0,
    out: Annotated[Path | None, typer.Option(help="Folder for recognition.json and overlay.png.")] = None,
) -> None:
    """Name every instance of one RGB-D frame."""
    import dataclasses

    from thor2_jax.files import write_text
    from thor2_jax.recognition.frames import read_frame
    from thor2_jax.recognition.overlay import draw_overlay
    from thor2_jax.recognition.recognizer import Recognizer

    frame = read_frame(color=color, depth=depth, labels=labels, intrinsics=intrinsics)
    answers = Recognizer.load(model, unknown_below).recognize(frame)
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


def _evaluate(
    kind: str,
    frames: Any,
    dataset: Path,
    models: Sequence[Path],
    out: Path | None,
    per_sequence: bool = False,
    **files: Any,
) -> None:
    from training.evaluation.job import evaluate_dataset
    from training.evaluation.page import accuracy_table
    from training.evaluation.runs import load_runs, load_sequence_runs

    if per_sequence and len(models) != 1:
        raise InputError(
            f"per_sequence: {len(models)} models are given; expected one folder with a run for each sequence"
        )

    description = {"kind": kind, "path": str(dataset.resolve())}
    description |= {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items() if path}
    with tempfile.TemporaryDirectory() as nowhere, _bar() as bar:
        runs = load_sequence_runs(models[0], frames.identifiers) if per_sequence else load_runs(models)
        found = evaluate_dataset(runs, frames, description, out or Path(nowhere) / "report", _stages(bar))
    counts, speed = found["instances"], found["speed"]
    if found["joinings"]:
        shown = Table("", "instances", *found["joinings"])
        for table in found["accuracy"][found["rule"]]:
            header, rows = accuracy_table(table, found["joinings"])
            shown.add_section()
            if header[0]:
                shown.add_row(f"by {header[0]}", style="bold")
            for row in rows:
                shown.add_row(*row)
        console.print(shown)
    console.print(
        f"{counts['scored']} instances scored, {sum(counts['not_described'].values())} of them could not be described "
        f"(counted as wrong); {sum(counts['no_class'].values())} are no class of the runs"
    )
    if speed["frames_per_second"]:
        console.print(
            f"{speed['frames']} frames, {speed['frames_per_second']:.2f} a second with compilation; "
            f"median {speed['median_seconds']:.2f} s a frame"
        )
    if out is not None:
        console.print(f"report: {out / 'report.html'}")


DatasetArgument = Annotated[Path, typer.Argument(help="The dataset's folder.")]
ModelsOption = Annotated[list[Path], typer.Option("--model", help="Run folder, or one with the folds of a training.")]
MoreModels = Annotated[list[Path] | None, typer.Argument(metavar="[RUN]...", help="Further run folders.")]
ReportOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for report.html and report.json; one that was begun goes on.")
]


@evaluate_app.command()
def uwis(dataset: DatasetArgument, model: ModelsOption, runs: MoreModels = None, out: ReportOption = None) -> None:
    """UW-IS Occluded: <video>/images/<id>_{rgb,depth,labels}.png and <id>_poses.yaml."""
    from training.readers.uwis import UWISOccluded

    _evaluate("uwis", UWISOccluded(dataset), dataset, [*model, *(runs or [])], out)


@evaluate_app.command()
def frames(dataset: DatasetArgument, model: ModelsOption, runs: MoreModels = None, out: ReportOption = None) -> None:
    """Single frames: <frame>/{color,depth,mask}.png, intrinsics.json, labels.json."""
    from training.readers.frames import FrameFolder

    _evaluate("frames", FrameFolder(dataset), dataset, [*model, *(runs or [])], out)


@evaluate_app.command()
def ocid(
    dataset: DatasetArgument,
    model: ModelsOption,
    names: Annotated[Path, typer.Option(help="YAML or JSON table: sequence -> object names in the order of placing.")],
    runs: MoreModels = None,
    per_sequence: Annotated[
        bool, typer.Option(help="RUN holds a run for each sequence, as `train --sequences` writes them.")
    ] = False,
    out: ReportOption = None,
) -> None:
    """OCID, subset YCB10: {table,floor}/{bottom,top}/<type>/<sequence>/{rgb,depth,label,pcd}."""
    from training.readers.ocid import OCID

    _evaluate("ocid", OCID(dataset, names), dataset, [*model, *(runs or [])], out, per_sequence, names=names)


@evaluate_app.command()
def bop(
    dataset: DatasetArgument,
    model: ModelsOption,
    names: Annotated[Path | None, typer.Option(help="YAML or JSON table: obj_id -> name. Default: obj_000001.")] = None,
    runs: MoreModels = None,
    out: ReportOption = None,
) -> None:
    """BOP format (YCB-Video and others): <scene>/{rgb,depth,mask_visib}, scene_camera.json and scene_gt.json."""
    from training.readers.bop import BOP

    _evaluate("bop", BOP(dataset, names), dataset, [*model, *(runs or [])], out, names=names)


@app.command()
def serve(
    model: ModelOption,
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 for other machines.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="0 takes a free one; the log tells.")] = 8080,
    workers: Annotated[int, typer.Option(min=1, help="Server processes; each has the model and its own queue.")] = 1,
    processes: Annotated[int, typer.Option(min=1, help="Of each worker, that decode images and make clouds.")] = 2,
    queue: Annotated[int, typer.Option(min=1, help="Requests a worker has at a time; more get status 429.")] = 32,
    deadline: Annotated[float, typer.Option(help="Seconds a request may take; then it gets status 504.")] = 5.0,
    max_batch: Annotated[int, typer.Option(help="Most clouds in a batch of the device.")] = 32,
    unknown_below: UnknownOption = 0.0,
    cache: Annotated[Path | None, typer.Option(help="Folder for compiled programs: the next start is quicker.")] = None,
    token: Annotated[str | None, typer.Option(envvar="THOR2_TOKEN", help="Bearer token that callers need.")] = None,
) -> None:
    """Answer recognition over HTTP (extra `serve`); see /openapi.json."""
    try:
        from thor2_jax.service.server import serve as serve_forever
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("thor2_jax"):
            raise
        raise InputError(f"{error.name} is not installed; serve needs: pip install 'thor2-jax[serve]'") from None
    from thor2_jax.service.settings import Settings

    settings = Settings(
        model, token, queue, deadline, max_batch, processes=processes, unknown_below=unknown_below, cache=cache
    )
    serve_forever(settings, host, port, workers)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the report, its pictures and the trained run.")],
    seed: Annotated[int, typer.Option(help="Of weights and scenes.")] = 0,
) -> None:
    """Train on built-in objects, recognize cluttered scenes of them, write a report. No download; a few minutes.

    Interrupted, it goes on when called again.
    """
    from training.demo import run_demo

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
