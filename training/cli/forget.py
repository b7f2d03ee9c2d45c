"""`thor2 forget`: remove an object from a run."""

from typing import Annotated

import typer

from training.cli import options
from training.cli.app import app, finish, option_arguments


@app.command()
def forget(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Enrolled object or trained class.")],
    model: options.ModelOption,
    gallery: options.GalleryOption = None,
) -> None:
    """Forget an object: remove its views; a trained class is no longer predicted."""
    from thor2_jax.recognizer import Recognizer

    recognizer = Recognizer.load(model, gallery=gallery)
    recognizer.forget(name)
    result = f"{name} is forgotten; {gallery or model} recognizes {recognizer.gallery.summary}"
    dashes = ["--"] if name.startswith("-") else []
    finish(result, "enroll it again", "enroll", *option_arguments(model=model, gallery=gallery), *dashes, name, "FRAME")
