"""`thor2 train`: train a recognizer."""

import atexit
import dataclasses
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from thor2_jax.errors import InputError
from training.cli import options
from training.cli.app import app, console, finish, show_progress


class _TrainCommand(options.ManyFrames):
    """The train command. Its help states the defaults of the protocols."""

    def insert_values(self) -> None:
        """Insert the values into the help, only when it is shown, since importing the protocols takes a second.

        "{own}" stands for the values of the protocols' field with the name of the option.
        """
        from training.protocol import DEFAULT, PAPER, QUICK

        parameters: list[Any] = self.params
        default, paper = (vars(each) | vars(each.fit) for each in (DEFAULT, PAPER))
        for option in parameters:
            text = option.help or ""
            if "{own}" in text:
                text = text.replace("{own}", f"({default[option.name]:g}; paper: {paper[option.name]:g})")
            option.help = text.format(default=DEFAULT, paper=PAPER, quick=QUICK)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Insert the values, and show the help."""
        self.insert_values()
        super().format_help(ctx, formatter)


@dataclasses.dataclass(frozen=True)
class JobOptions:
    """Options that are fields of `TrainJob`."""

    out: Annotated[Path, typer.Option(help="Run directory: new, or begun by this command.")]
    meshes: Annotated[Path | None, typer.Option(help="Folder of meshes (GLB, OBJ, PLY) to render.")] = None
    dataset: Annotated[
        Path | None,
        typer.Option(help="Directory written by `thor2 render`, instead of --meshes."),
    ] = None
    names: options.NamesOption = None
    weights: Annotated[
        Path | None,
        typer.Option(help="Folder of pretrained weights (safetensors) for the networks. Default: from scratch."),
    ] = None
    sequences: Annotated[
        Path | None,
        typer.Option(help="YAML or JSON table: sequence -> its objects. One run per sequence, in OUT/<sequence>."),
    ] = None
    mesh_scale: options.MeshScaleOption = 1.0
    workers: Annotated[int, typer.Option(min=1, max=options.MAX_WORKERS, help="Rendering processes.")] = 2


@dataclasses.dataclass(frozen=True)
class ProtocolOptions:
    """Options that replace values of the protocol; None keeps a value."""

    azimuth_step: Annotated[float | None, typer.Option(help="Degrees between cameras around the object. {own}")] = None
    polar_step: Annotated[float | None, typer.Option(help="Degrees between cameras from pole to pole. {own}")] = None
    epochs: Annotated[
        int | None,
        typer.Option(
            help="Epochs of the embedding ({default.distractors.epochs}) and of the classifiers ({default.fit.epochs}; "
            "paper: {paper.fit.epochs}), whose learning rate is {default.fit.learning_rates[0]:g} in the first half "
            "and {default.fit.learning_rates[1]:g} in the second."
        ),
    ] = None
    batch_size: Annotated[int | None, typer.Option(help="Samples per step of the classifiers. {own}")] = None
    seed: Annotated[int, typer.Option(help="Seed for augmentations, weights, sample order and dropout.")] = 0
    folds: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of folds; if more than 1, one model per held-out fold.")
    ] = 1
    orientation_copies: Annotated[
        int | None,
        typer.Option(min=0, help="Additional samples of each view in random orientations, for the classifiers. {own}"),
    ] = None


@app.command(cls=_TrainCommand)
@options.grouped_options
def train(
    given: JobOptions,
    settings: ProtocolOptions,
    frames: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR...", help="Folders of labelled frames; their instances are used as views, too."),
    ] = None,
    paper: Annotated[bool, typer.Option("--paper", help="Use the paper's protocol.")] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="Train in three quarters of the time, with fewer distractors and networks.")
    ] = False,
    classifiers: Annotated[
        str | None,
        typer.Option(
            help="The paper's classifiers to train in addition, comma-separated: tops, tops2, ce. (none; all "
            "without an embedding, as with --paper)"
        ),
    ] = None,
    baselines: Annotated[
        str,
        typer.Option(
            help="Comma-separated baselines to train, too: thor, forest, pointnet, templates, rcfusion, vit-cnn, "
            "rgbd-vit; the last three also with -small."
        ),
    ] = "",
    leave_out: Annotated[str, typer.Option(help="Comma-separated objects to leave out of the training.")] = "",
    embedding: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Fit the run's embedding on N procedural distractors and the views; 0 fits none. "
            "({default.distractors.procedural}; quick: {quick.distractors.procedural}; paper: 0)",
        ),
    ] = None,
    distractors: Annotated[
        Path | None, typer.Option(help="Folder of meshes of further distractors: objects of none of the classes.")
    ] = None,
    coordinator: Annotated[
        str | None, typer.Option(help="HOST:PORT of process 0, for training with several processes.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Number of processes that train together.")] = 1,
    process: Annotated[int, typer.Option(min=0, help="Index of this process.")] = 0,
    quiet: options.QuietOption = False,
) -> None:
    """Train a recognizer on views of meshes, labelled frames or both. An interrupted training resumes.

    A run recognizes objects by an embedding: several small networks, fitted on the views and on distractors. Since
    distractors are objects of none of the classes, unknown objects get a low confidence. The embedding is also used to
    enroll new objects.

    With --meshes, each view is used as rendered and in augmented copies, with other light, partial occlusion, depth
    sensor errors and inexact masks. A --dataset already contains its augmented copies. --quick fits fewer networks
    on fewer distractors. --paper trains the paper's classifiers as the paper does, without an embedding: more
    views, no augmented copies, four mirrors of each view and more epochs.

    With --frames, labelled real instances are used as views, too, each with augmented copies. Each object may have
    a mesh, frames or both. A frame is a folder with color.png, depth.png, mask.png, intrinsics.json and labels.json.

    With --baselines, the missing baselines are added to a finished run. The image networks among them read crops (see
    `thor2 render --crops`) and are trained from scratch or from --weights.

    With --sequences, one run is trained for each sequence, on its objects only (see `thor2 evaluate ocid
    --per-sequence`). Finished runs must have been trained with the same options.
    """
    import jax

    options.check_alone("quick", quick, paper=paper)
    if (given.meshes is None) == (given.dataset is None) and (given.meshes is not None or not frames):
        raise InputError("give --meshes, --dataset or --frames; only --frames goes with one of the others")
    scale = options.given_values(given).get("mesh_scale")
    steps = {"azimuth_step": settings.azimuth_step, "polar_step": settings.polar_step}
    options.check_belongs("--meshes", given.meshes, names=given.names, **steps)
    options.check_belongs("--meshes or --distractors", given.meshes or distractors, mesh_scale=scale)
    options.check_belongs("--dataset", given.dataset, sequences=given.sequences)
    options.check_alone("sequences", given.sequences, leave_out=leave_out)
    if coordinator is None and (processes, process) != (1, 0):
        raise InputError(f"processes is {processes} and process {process}; several processes need --coordinator")
    if process >= processes:
        raise InputError(f"process is {process}; expected less than --processes, which is {processes}")
    if coordinator is not None:
        if given.meshes is not None or frames:
            raise InputError("coordinator: all processes need to read a --dataset, not --meshes or --frames")
        if not re.fullmatch(r".+:[0-9]+", coordinator):
            raise InputError(f"coordinator is {coordinator!r}; expected HOST:PORT of process 0")
        jax.distributed.initialize(coordinator, processes, process)
    from training.objects.meshes import find_meshes, scaled_meshes
    from training.protocol import DEFAULT, PAPER, QUICK
    from training.storage.workers import keep_freed_memory
    from training.train_job import TrainJob, run_train_job

    keep_freed_memory()
    protocol = PAPER if paper else QUICK if quick else DEFAULT
    others = {} if distractors is None else scaled_meshes(find_meshes(distractors), given.mesh_scale)
    protocol = protocol.with_distractors(embedding, others, given.workers)
    features = None if classifiers is None else options.split_names(classifiers)
    of_classifiers = {"batch_size": settings.batch_size, "orientation_copies": settings.orientation_copies}
    options.check_belongs("--classifiers or --paper", features or protocol.classifiers or baselines, **of_classifiers)
    job = TrainJob(
        protocol=protocol.replace(classifiers=features, **vars(settings)),
        frames=frames or (),
        baselines=options.split_names(baselines),
        leave_out=options.split_names(leave_out),
        **vars(given),
    )
    try:
        with show_progress(quiet) as progress:
            trained = run_train_job(job, progress)
    except BaseException as error:
        # JAX would wait for the other processes at exit, while they wait for the next step of this process.
        if processes > 1:
            atexit.register(os._exit, 130 if isinstance(error, KeyboardInterrupt) else 2)
        if "Gloo" in str(error):  # JAX's communication between processors
            raise InputError("coordinator: another process has ended; start all of them again to resume") from error
        raise
    for directory, runs in trained.items():
        _report(directory, runs, has_baselines=bool(job.baselines))


def _report(directory: Path, runs: Sequence[Any], has_baselines: bool) -> None:
    """Print the accuracy of the runs in a directory, the skipped instances, and the command that recognizes."""
    from thor2_jax.gallery.store import GALLERY_DIRECTORY, load_gallery
    from thor2_jax.model.run_record import RUN_FILE

    for reason in runs[0].record["dataset"].get("frames", {}).get("skipped", []) if runs else []:
        console.print(f"skipped: {reason}")
    for run in runs:
        fold = f"fold {run.record['fold']}: " if len(runs) > 1 else ""
        for name, accuracy in run.record["held_out_accuracy"].items():
            console.print(f"{fold}{name} has a held-out accuracy of {accuracy:.3f}")
        if run.embedding is not None and run.surfaces is None:
            console.print(f"{fold}no surfaces: a class has no mesh, or its dataset is of an earlier version")
    model = directory if (directory / RUN_FILE).is_file() else directory / "fold-0"
    if runs and (enrolled := load_gallery(model / GALLERY_DIRECTORY).objects):
        views = ", ".join(f"{name} (views: {len(each.clouds)})" for name, each in enrolled.items())
        console.print(f"enrolled, too, since they have no mesh: {views}")
    finished = f"finished already: {'only missing baselines were' if has_baselines else 'nothing was'} trained"
    objects = f" (objects: {len(runs[0].classes)})" if runs else ""
    written = "run written to" if runs else f"{finished}; the run is in"
    frame = "--color color.png --depth depth.png --labels mask.png --intrinsics intrinsics.json".split()
    finish(f"{written} {directory}{objects}", "recognize a frame", "recognize", "--model", model, *frame)
