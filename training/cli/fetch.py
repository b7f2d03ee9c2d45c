"""`thor2 fetch`: download meshes. No other command downloads anything."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli import options
from training.cli.app import app, console, finish, show_help, show_progress

fetch_app = typer.Typer(callback=show_help, invoke_without_command=True, help="Download public meshes.")
app.add_typer(fetch_app, name="fetch")


@fetch_app.command()
def ycb(
    objects: Annotated[
        str, typer.Option(help="Comma-separated names as in the set, such as 003_cracker_box,011_banana.")
    ],
    out: Annotated[Path, typer.Option(help="Directory for the meshes, one folder for each object.")],
    url: Annotated[str | None, typer.Option(help="Address of the folder of archives on a mirror.")] = None,
    quiet: options.QuietOption = False,
) -> None:
    """Download scans of the YCB Object and Model Set (CC BY 4.0), about 10 MB for each object.

    An interrupted download resumes, and existing objects are not downloaded again. Pass the directory to
    `thor2 train --meshes`.
    """
    from training.objects.fetch_ycb import LICENCE, YCB_URL, fetch_ycb

    console.print(LICENCE, soft_wrap=True)
    with show_progress(quiet) as progress:
        meshes = fetch_ycb(options.split_names(objects), out, url=url or YCB_URL, progress=progress)
    for name in meshes:
        console.print(name)
    finish(f"meshes in {out}: {len(meshes)}", "train on them", "train", meshes=out, out="run")
