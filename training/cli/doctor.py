"""`thor2 doctor`: find likely errors in a set-up."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thor2_jax.errors import InputError, reason_of
from thor2_jax.printable import escape_characters
from training.cli import options
from training.cli.app import app, finish, print_note

if TYPE_CHECKING:
    from training.diagnosis.checks import Diagnosis


@app.command()
@options.grouped_options
def doctor(
    given: options.FrameOptions,
    model: Annotated[
        Path | None, typer.Option(help="Run directory trained on the objects, to check the channel order.")
    ] = None,
    meshes: Annotated[
        Path | None,
        typer.Option(help="Mesh of the object, or folder of meshes, to check units, sizes and the focal length."),
    ] = None,
    mesh_scale: options.MeshScaleOption = 1.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print findings and notes for each FRAME as JSON.")] = False,
) -> None:
    """Find likely errors in frames: units, intrinsics, registration, labels, colours.

    The exit code is 0 if no error is found, 1 if an error is likely, and 2 if a file is missing.
    """
    from training.diagnosis.setup import diagnose
    from training.frame_recognition import RecognizerArguments
    from training.objects.meshes import find_meshes

    options.check_belongs("--meshes", meshes, mesh_scale=None if mesh_scale == 1 else mesh_scale)
    sources = given.sources(masks=False)
    paths = {} if meshes is None else {meshes.stem: meshes} if meshes.is_file() else find_meshes(meshes)
    recognizer = None if model is None else RecognizerArguments(model).load()
    known: dict[str, Any] = {"recognizer": recognizer, "meshes": paths, "mesh_scale": mesh_scale}
    is_sound, failed, printed = True, [], dict[str, str | None]()
    for source in sources:
        try:
            diagnosis = diagnose(source.files or source.read(), depth_scale=given.depth_scale, **known)
        except (InputError, OSError) as error:
            if given.color:
                raise
            failed.append(source.name)
            print_note(f"failed: {source.name}: {reason_of(error)}")
        else:
            _report(diagnosis, as_json, None if given.color else source.name, printed)
            is_sound &= not diagnosis.findings
    if failed:
        raise InputError(f"{len(failed)} of {len(sources)} frames cannot be read; see above")
    result = f"frames checked: {len(sources)}"
    if is_sound and not as_json:
        finish(result, "recognize", "recognize", *given.arguments(), model=model or "RUN")
    elif not as_json:
        finish(result, "after a change, check again", *sys.argv[1:])
    if not is_sound:
        raise typer.Exit(1)


def _report(diagnosis: "Diagnosis", as_json: bool, frame: str | None, printed: dict[str, str | None]) -> None:
    """Print a diagnosis, or the frame with the same one; `printed` is diagnosis -> first frame, and is extended."""
    if as_json:
        print(json.dumps(({} if frame is None else {"frame": frame}) | dataclasses.asdict(diagnosis)), flush=True)
        return
    lines = [f"{finding.code}: {finding.message} {finding.advice}" for finding in diagnosis.findings]
    lines += [f"note: {note}" for note in diagnosis.notes]
    lines += [] if diagnosis.findings else ["nothing found"]
    first = printed.setdefault("\n".join(lines), frame)
    if frame is not None:
        lines = [f"{frame}:", *lines] if first == frame else [f"{frame}: as {first}"]
    print("\n".join(map(escape_characters, lines)), flush=True)
