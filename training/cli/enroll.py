"""`thor2 enroll`: teach a run new objects, without training."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thor2_jax.errors import InputError
from training.cli.app import GalleryOption, ManyFrames, MeshScaleOption, QuietOption, app, console
from training.cli.progress import show_progress

if TYPE_CHECKING:
    from thor2_jax.recognition.prepared_instance import PreparedInstance


@app.command(cls=ManyFrames)
def enroll(
    model: Annotated[Path, typer.Option("--model", help="Run directory; created if it does not exist.")],
    name: Annotated[str | None, typer.Argument(help="Name of the object. Default: every labelled object.")] = None,
    mesh: Annotated[Path | None, typer.Option(help="Mesh of the object (GLB, OBJ, PLY), in metres.")] = None,
    frames: Annotated[
        list[Path] | None, typer.Option(metavar="DIR...", help="Folders of labelled frames, or labelled frames.")
    ] = None,
    label_name: Annotated[str | None, typer.Option(help="Name of the object in labels.json. Default: NAME.")] = None,
    color: Annotated[Path | None, typer.Option(help="Color image of one frame, PNG or JPEG.")] = None,
    depth: Annotated[Path | None, typer.Option(help="Depth image: 16-bit PNG, float TIFF, NPY or EXR.")] = None,
    labels: Annotated[Path | None, typer.Option(help="Instance labels, PNG; 0 is background.")] = None,
    intrinsics: Annotated[
        Path | None, typer.Option(help="fx, fy, cx, cy in JSON, ROS camera_info, K, BOP, RealSense or Open3D.")
    ] = None,
    instance: Annotated[int | None, typer.Option(help="Label number of the object in this frame.")] = None,
    mesh_scale: MeshScaleOption = 1.0,
    extend: Annotated[bool, typer.Option("--extend", help="Add views to an object that exists.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Discard the views of an object that exists.")] = False,
    gallery: GalleryOption = None,
    quiet: QuietOption = False,
) -> None:
    """Enroll an object from a mesh, from labelled frames, or from one frame; it is recognized at once.

    Without NAME, every labelled object of the frames is enrolled. A frame is a folder with color.png, depth.png,
    mask.png, intrinsics.json and labels.json. The confidence below which an object is unknown depends on its number of
    views; see --unknown-below of `thor2 recognize`.
    """
    from thor2_jax.gallery.enrollment import instance_view
    from training.enrollment import enroll_objects, labelled_views, mesh_views

    images = {"color": color, "depth": depth, "labels": labels, "intrinsics": intrinsics, "instance": instance}
    _check_sources(name, mesh, frames, label_name, images)
    if mesh is None and mesh_scale != 1:
        raise InputError(f"mesh_scale is {mesh_scale:g}; it belongs to --mesh")
    skipped: list[str] = []

    def read(sigma_s: float) -> Mapping[str, Sequence["PreparedInstance"]]:
        if mesh is not None:
            assert name is not None
            return {name: mesh_views(mesh, mesh_scale)}
        if frames:
            views, unusable = labelled_views(frames, sigma_s, label_name or name)
            skipped.extend(f"skipped: {each.reason}" for each in unusable)
            return views if name is None else {name: [view for each in views.values() for view in each]}
        from thor2_jax.recognition.frames import read_frame

        assert name is not None and color and depth and labels and intrinsics and instance is not None
        frame = read_frame(color=color, depth=depth, labels=labels, intrinsics=intrinsics)
        return {name: [instance_view(frame, instance, sigma_s)]}

    source = "frames" if mesh is None else "mesh"
    counts = enroll_objects(
        model,
        read,
        source,
        name=name,
        extend=extend,
        replace=replace,
        gallery=gallery,
        progress=partial(show_progress, quiet),
    )
    for line in skipped:
        console.print(line)
    for each, count in counts.items():
        console.print(f"{each}: {count} views")
    console.print(f"enrolled in {gallery or model}")


def _check_sources(
    name: str | None, mesh: Path | None, frames: list[Path] | None, label_name: str | None, images: dict[str, Any]
) -> None:
    given = [option for option, value in images.items() if value is not None]
    if bool(mesh) + bool(frames) + bool(given) != 1:
        raise InputError("give exactly one of --mesh, --frames, and --color with --depth, --labels, --intrinsics, ...")
    if given and len(given) < len(images):
        missing = ", ".join(f"--{option}" for option in images if option not in given)
        raise InputError(f"{given[0]} is given without {missing}; one frame needs all of them")
    if name is None and (not frames or label_name is not None):
        raise InputError("name is missing; only --frames without --label-name enrolls every labelled object")
    if label_name is not None and not frames:
        raise InputError(f"label_name is {label_name!r}; it belongs to --frames")
