"""`thor2 render`: render a dataset of training views."""

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from training.cli import options
from training.cli.app import app, finish, show_progress

COPIES = 5


@dataclasses.dataclass(frozen=True)
class AugmentationOptions:
    """The augmentations applied to the copies."""

    illumination: Annotated[bool, typer.Option("--illumination", help="Augment: light and camera response.")] = False
    sensor: Annotated[bool, typer.Option("--sensor", help="Augment: noise, smoothing and gaps of depth.")] = False
    occlusion: Annotated[bool, typer.Option("--occlusion", help="Augment: another object in front.")] = False
    segmentation: Annotated[bool, typer.Option("--segmentation", help="Augment: inexact masks.")] = False
    registration: Annotated[
        bool, typer.Option("--registration", help="Augment: blurred colour, shifted against depth.")
    ] = False
    base: Annotated[bool, typer.Option("--base", help="Augment: masks that lack the lowest part.")] = False


@app.command()
@options.grouped_options
def render(
    *,
    processes: options.RenderWorkers,
    meshes: Annotated[Path, typer.Option(help="Folder of meshes (GLB, OBJ, PLY), one per file or subfolder.")],
    out: Annotated[Path, typer.Option(help="Directory for the views: new, or begun by this command.")],
    names: options.NamesOption = None,
    azimuth_step: Annotated[float, typer.Option(help="Degrees between cameras around the object.")] = 5.0,
    polar_step: Annotated[float, typer.Option(help="Degrees between cameras from pole to pole.")] = 5.0,
    kinds: AugmentationOptions,
    copies: Annotated[int, typer.Option(help="Augmented copies of each view, if there are augmentations.")] = COPIES,
    seed: Annotated[int, typer.Option(help="Seed for the augmentations.")] = 0,
    crops: Annotated[
        int | None,
        typer.Option(metavar="PIXELS", min=1, max=2048, help="Also write crops of this size, for image networks."),
    ] = None,
    mesh_scale: options.MeshScaleOption = 1.0,
    quiet: options.QuietOption = False,
) -> None:
    """Render views of meshes to a dataset for `train --dataset`. An interrupted rendering resumes.

    With --crops, the views are rendered a second time, and crops of their colour and surface normals are written to
    OUT/crops. This also works for a finished dataset. The image networks among the baselines of `train` are trained on
    the crops (224 pixels; 96 for their small variants).
    """
    from training.augmentation.augmentations import Augmentations
    from training.objects.meshes import find_meshes, scaled_meshes
    from training.storage.jobs import of_stage
    from training.storage.workers import IN_PROCESS
    from training.views.dataset import render_crops, render_dataset
    from training.views.mesh_views import RenderJob

    given_copies = None if copies == COPIES else copies
    options.check_belongs("an augmentation, such as --sensor", any(vars(kinds).values()), copies=given_copies)
    pool = processes.pool() or IN_PROCESS
    augmentations = Augmentations.of_names([name for name, on in vars(kinds).items() if on], copies) or None
    sources = scaled_meshes(find_meshes(meshes, names), mesh_scale)
    job = RenderJob(sources, azimuth_step, polar_step, augmentations, seed)
    with show_progress(quiet) as progress:
        dataset = render_dataset(job, out, pool, progress)
        if crops is not None:
            render_crops(job, dataset, crops, pool, of_stage(progress, "render crops"))
    views = f"views in {out}: {len(dataset)} (objects: {len(dataset.classes)}, left out: {dataset.left_out})"
    finish(views, "train on them", "train", dataset=out, out="run")
