"""`thor2 enroll`: add new objects to a run, without training."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated

import typer

from thor2_jax.errors import InputError
from thor2_jax.printable import check_name
from training.cli import options
from training.cli.app import app, console, finish, show_progress


@dataclasses.dataclass(frozen=True)
class EnrollOptions:
    """Options that are arguments of `enroll_objects`."""

    label_name: Annotated[str | None, typer.Option(help="Name of the object in labels.json. Default: NAME.")] = None
    instance: Annotated[
        int | None, typer.Option(help="Label number of the object. Default: as in labels.json, or the only instance.")
    ] = None
    mesh_scale: options.MeshScaleOption = 1.0
    extend: Annotated[bool, typer.Option("--extend", help="Add the views to an existing object.")] = False
    replace: Annotated[bool, typer.Option("--replace", help="Replace the views of an existing object.")] = False
    gallery: options.GalleryOption = None


@app.command(cls=options.ManyFrames)
@options.grouped_options
def enroll(
    *,
    model: Annotated[Path, typer.Option(help="Run directory; created if it does not exist.")],
    name: Annotated[str | None, typer.Argument(metavar="NAME", help="Name of the object. Default: all.")] = None,
    given: options.FrameOptions,
    mesh: Annotated[
        Path | None, typer.Option(help="Mesh of the object (GLB, OBJ, PLY), its folder, or a folder of objects.")
    ] = None,
    labelled: Annotated[
        list[Path] | None,
        typer.Option("--frames", metavar="FRAME...", help="Frames; without NAME, all their labelled objects."),
    ] = None,
    target: EnrollOptions,
    segment: options.SegmentOption = None,
    processes: options.RenderWorkers,
    quiet: options.QuietOption = False,
) -> None:
    """Enroll an object from a mesh or from frames, so that it is recognized from then on.

    Without NAME, every object that is named in the labels.json of the frames, or every object in the folder of --mesh,
    is enrolled. With NAME, frames without labels.json need --instance, unless the object is their only instance. A
    frame is a folder with color.png, depth.png, mask.png, intrinsics.json and labels.json. The confidence below which
    an answer is "unknown" depends on the object's number of views, or has one value for objects with a mesh; see
    --unknown-below of `thor2 recognize`.
    """
    name = None if name is None else check_name(name)
    if mesh is None and name is not None and "/" in name and os.path.isdir(name):
        raise InputError(f"name is the folder {name!r}; expected an object. For every object, give --frames FOLDER")
    given = dataclasses.replace(given, frames=[*(given.frames or []), *(labelled or [])])
    has_frames = bool(given.arguments())
    if bool(mesh) == has_frames:
        raise InputError("give exactly one of --mesh and frames: FRAME... after a NAME, --frames, --color ... or --bag")
    options.check_belongs("frames", has_frames, label_name=target.label_name, instance=target.instance, segment=segment)
    if name is None and any(each is not None for each in (target.label_name, target.instance, given.bag, segment)):
        raise InputError("name is missing; --label-name, --instance, --bag and --segment enroll one object")
    options.check_alone("replace", target.replace, extend=target.extend)
    options.check_alone("instance", target.instance, label_name=target.label_name)
    scale = options.given_values(target).get("mesh_scale")
    options.check_belongs("--mesh", mesh, mesh_scale=scale, **options.given_values(processes))
    from training.objects.meshes import find_object_meshes

    meshes = {} if mesh is None else find_object_meshes(mesh, name)
    frames = [] if meshes else given.sources(segment)
    from training.enrollment import enroll_objects  # takes seconds, so the arguments are checked first
    from training.readers.frames import FrameFolder
    from training.storage.workers import IN_PROCESS

    source = meshes or FrameFolder(frames, named=None if target.instance is not None else name is None)
    pool = dataclasses.replace(processes, workers=min(processes.workers, len(meshes) or 1)).pool() or IN_PROCESS
    with show_progress(quiet) as progress:
        counts, known, notes = enroll_objects(model, source, name=name, pool=pool, progress=progress, **vars(target))
    for note in notes:
        console.print(note)
    if target.instance is not None and len(frames) > 1 and (given.bag or segment):
        console.print(
            f"warning: instance {target.instance} may be a different object in each frame, since each is segmented "
            "separately; check it with thor2 recognize, or enroll one frame at a time"
        )
    for each, count in counts.items():
        console.print(f"views of {each}: {count}")
    if known.weak_rejection:
        console.print(f"warning: unknown objects are hardly rejected: {known.weak_rejection}")
    enrolled = f"enrolled in {target.gallery or model}, which recognizes {known.gallery.summary}"
    # `thor2 recognize` uses the gallery in the run directory.
    then = ("serve the objects", "serve") if target.gallery else ("recognize a frame", "recognize", "FRAME")
    finish(enrolled, *then, model=model, gallery=target.gallery)
