"""`thor2 doctor`: say what is likely wrong with a set-up."""

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from training.cli.app import MeshScaleOption, app


@app.command()
def doctor(
    color: Annotated[Path, typer.Option(help="Color image, PNG or JPEG.")],
    depth: Annotated[Path, typer.Option(help="Depth image: 16-bit PNG, float TIFF, NPY or EXR.")],
    intrinsics: Annotated[
        Path, typer.Option(help="fx, fy, cx, cy in JSON, ROS camera_info, K, BOP, RealSense or Open3D.")
    ],
    labels: Annotated[Path | None, typer.Option(help="Instance labels, PNG; 0 is background.")] = None,
    depth_scale: Annotated[
        float | None, typer.Option(help="Depth units per metre. Default: that of the intrinsics, or 1000.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Run directory that knows the objects: checks the channel order.")
    ] = None,
    meshes: Annotated[
        Path | None, typer.Option(help="Mesh, or directory of meshes, of the objects: checks units and sizes.")
    ] = None,
    mesh_scale: MeshScaleOption = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON: findings and notes.")] = False,
) -> None:
    """Say what is likely wrong with a frame: units, intrinsics, registration, labels, colours.

    The exit code is 0 if nothing is found, 1 if something is likely wrong, and 2 if a file is missing.
    """
    from training.diagnosis.setup import diagnose
    from training.objects.meshes import find_meshes
    from training.readers.frame_files import FrameFiles

    if meshes is None and mesh_scale != 1:
        raise InputError(f"mesh_scale is {mesh_scale:g}; it belongs to --meshes")
    paths: list[Path] = []
    if meshes is not None:
        paths = list(find_meshes(meshes).values()) if meshes.is_dir() else [meshes]
    recognizer = None
    if model is not None:
        from thor2_jax.capacity import BATCH_BUCKETS
        from thor2_jax.recognizer import Recognizer

        recognizer = Recognizer.load(model)
        recognizer.chunk = BATCH_BUCKETS[-1]
    diagnosis = diagnose(
        FrameFiles(color, depth, labels, intrinsics),
        depth_scale=depth_scale,
        recognizer=recognizer,
        meshes=paths,
        mesh_scale=mesh_scale,
    )
    if as_json:
        print(json.dumps(dataclasses.asdict(diagnosis)))
    else:
        for finding in diagnosis.findings:
            print(escape_characters(f"{finding.code}: {finding.message} {finding.advice}"))
        for note in diagnosis.notes:
            print(escape_characters(f"note: {note}"))
        if not diagnosis.findings:
            print("nothing found")
    if diagnosis.findings:
        raise typer.Exit(1)
