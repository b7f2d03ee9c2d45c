"""`thor2 forget`: remove an object from a run."""

from typing import Annotated

import typer

from thor2_jax.printable import escape_characters
from training.cli.app import GalleryOption, ModelOption, app, console


@app.command()
def forget(
    name: Annotated[str, typer.Argument(help="Name of an enrolled object or of a trained class.")],
    model: ModelOption,
    gallery: GalleryOption = None,
) -> None:
    """Forget an object: its views are removed, and a trained class is never answered again."""
    from thor2_jax.recognizer import Recognizer

    recognizer = Recognizer.load(model, gallery=gallery)
    recognizer.forget(name)
    console.print(f"{escape_characters(name)} is forgotten; {model} knows {len(recognizer.classes)} objects")
