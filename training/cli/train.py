"""`thor2 train`: train a recognizer."""

import functools
from pathlib import Path
from typing import Annotated, Any

import typer

from thor2_jax.errors import InputError
from training.cli.app import ManyFrames, MeshScaleOption, QuietOption, app, console, split_names
from training.cli.progress import show_progress


@app.command(cls=ManyFrames)
def train(
    out: Annotated[Path, typer.Option(help="Run directory: new, or begun by this command.")],
    meshes: Annotated[Path | None, typer.Option(help="Directory of meshes (GLB, OBJ, PLY) to render.")] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="Directory written by `thor2 render`, instead of --meshes.")
    ] = None,
    frames: Annotated[
        list[Path] | None,
        typer.Option(metavar="DIR...", help="Folders of labelled frames, whose instances are views, too."),
    ] = None,
    names: Annotated[
        Path | None, typer.Option(help="JSON or YAML table: object name -> mesh. Default: all meshes.")
    ] = None,
    paper: Annotated[bool, typer.Option(help="Use the paper's protocol.")] = False,
    azimuth_step: Annotated[
        float | None, typer.Option(help="Degrees between cameras around the object. (20; paper: 5)")
    ] = None,
    polar_step: Annotated[
        float | None, typer.Option(help="Degrees between cameras from pole to pole. (15; paper: 5)")
    ] = None,
    classifiers: Annotated[str, typer.Option(help="Comma-separated: tops, tops2, ce.")] = "tops,tops2,ce",
    epochs: Annotated[
        int | None, typer.Option(help="Half at a learning rate of 1e-2, half at 1e-3. (24; paper: 100)")
    ] = None,
    batch_size: Annotated[int | None, typer.Option(help="Samples per step. (256; paper: 128)")] = None,
    seed: Annotated[int, typer.Option(help="Seed for augmentations, weights, sample order and dropout.")] = 0,
    folds: Annotated[int, typer.Option(min=1, help="More than 1: one model per fold, which is its held-out set.")] = 1,
    baselines: Annotated[
        str,
        typer.Option(
            help="Comma-separated baselines to train too: thor, forest, pointnet; rcfusion, vit-cnn, rgbd-vit, each "
            "also with -small; templates."
        ),
    ] = "",
    weights: Annotated[
        Path | None,
        typer.Option(help="Directory of pretrained weights (safetensors) for the networks. Default: from scratch."),
    ] = None,
    leave_out: Annotated[str, typer.Option(help="Comma-separated objects to train without.")] = "",
    sequences: Annotated[
        Path | None,
        typer.Option(help="YAML or JSON table: sequence -> its objects. One run per sequence, in OUT/<sequence>."),
    ] = None,
    embedding: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Fit the run's embedding on N procedural distractors and the views; 0 fits none. (1500; paper: 0)",
        ),
    ] = None,
    orientation_copies: Annotated[
        int | None, typer.Option(min=0, help="Further samples of each view, in random orientations. (2; paper: 0)")
    ] = None,
    distractors: Annotated[
        Path | None, typer.Option(help="Directory of meshes of objects that are none of the classes.")
    ] = None,
    mesh_scale: MeshScaleOption = 1.0,
    workers: Annotated[int, typer.Option(min=1, help="Rendering processes.")] = 2,
    coordinator: Annotated[
        str | None, typer.Option(help="HOST:PORT of process 0, for training with several processes.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Number of processes that train together.")] = 1,
    process: Annotated[int, typer.Option(min=0, help="Index of this process.")] = 0,
    quiet: QuietOption = False,
) -> None:
    """Train a recognizer on synthetic views of meshes. An interrupted training resumes.

    With --meshes, each view is used as rendered and in five augmented copies, with other light, partial occlusion,
    depth sensor errors and inexact masks. A --dataset has the copies that it was rendered with. --paper trains as the
    paper does: more views, no augmented copies, four mirrors of each view and more epochs.

    With --frames, labelled real instances are views of their objects, too, each with augmented copies. Objects may have
    a mesh, frames or both. A frame is a folder with color.png, depth.png, mask.png, intrinsics.json and labels.json.

    With --baselines, a finished run gets the baselines that it lacks. The image networks among them read crops (see
    `thor2 render --crops`) and are trained from scratch or from --weights.

    With --sequences, one run is trained for each sequence, on its objects only (see `thor2 evaluate ocid
    --per-sequence`); finished runs must have the same options. The embedding gives the confidence of an answer, and
    objects are enrolled in the run with it. It is also fitted on distractors, objects that are none of the classes, so
    that unknown objects get a low confidence.
    """
    import jax

    if (meshes is None) == (dataset is None) and (meshes is not None or not frames):
        raise InputError("give one of --meshes and --dataset, --frames, or both")
    for option, value in (("names", names), ("azimuth-step", azimuth_step), ("polar-step", polar_step)):
        if meshes is None and value is not None:
            raise InputError(f"{option} is {value}; expected only with --meshes: other views are not rendered")
    if meshes is None and mesh_scale != 1:
        raise InputError(f"mesh-scale is {mesh_scale:g}; expected only with --meshes: other views are not rendered")
    if coordinator is None and (processes, process) != (1, 0):
        raise InputError(f"processes is {processes} and process {process}; several processes need --coordinator")
    if process >= processes:
        raise InputError(f"process is {process}; expected less than --processes, which is {processes}")
    if sequences is not None and (dataset is None or leave_out):
        raise InputError(f"sequences is {sequences}; it requires --dataset and excludes --leave-out")
    if coordinator is not None:
        if meshes is not None or frames:
            raise InputError(
                "coordinator: several processes need a --dataset that all of them can read, not --meshes or --frames"
            )
        jax.distributed.initialize(coordinator, processes, process)
    from training.fitting.protocol import DEFAULT, PAPER
    from training.train_job import TrainJob, run_train_job

    job = TrainJob(
        out=out,
        protocol=(PAPER if paper else DEFAULT).replace(
            azimuth_step=azimuth_step,
            polar_step=polar_step,
            epochs=epochs,
            batch_size=batch_size,
            seed=seed,
            orientation_copies=orientation_copies,
        ),
        meshes=meshes,
        dataset=dataset,
        frames=frames or (),
        names=names,
        classifiers=split_names(classifiers),
        folds=folds,
        baselines=split_names(baselines),
        weights=weights,
        leave_out=split_names(leave_out),
        sequences=sequences,
        distractors=_distractors(0 if paper and embedding is None else embedding, distractors, workers),
        workers=workers,
        mesh_scale=mesh_scale,
    )
    trained = run_train_job(job, functools.partial(show_progress, quiet))
    for directory, runs in trained.items():
        if not runs:
            console.print(f"finished already: nothing was trained; the run is in {directory}")
            continue
        for reason in runs[0].record["dataset"].get("frames", {}).get("skipped", []):
            console.print(f"skipped: {reason}")
        for run in runs:
            for name, accuracy in run.record["held_out_accuracy"].items():
                console.print(f"fold {run.record['fold']}: {name} has a held-out accuracy of {accuracy:.3f}")
        console.print(f"run written to {directory}")


def _distractors(procedural: int | None, meshes: Path | None, workers: int) -> Any:
    """Return the distractors of the options; None fits no embedding."""
    from training.embedding.run_embedding import Distractors
    from training.objects.meshes import find_meshes

    if procedural == 0 and meshes is None:
        return None
    paths = {} if meshes is None else find_meshes(meshes)
    if procedural is None:
        return Distractors(meshes=paths, workers=workers)
    return Distractors(procedural, paths, workers=workers)
