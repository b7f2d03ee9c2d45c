"""`thor2 objects`: list the objects that a run recognizes."""

from typing import Annotated

import typer
from rich.table import Table

from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from training.cli.app import GalleryOption, ModelOption, app, console, finish


@app.command()
def objects(
    model: ModelOption,
    gallery: GalleryOption = None,
    reembed: Annotated[
        bool,
        typer.Option(
            "--reembed",
            help="Embed all enrolled views again, after a change of the embedding; rebuild a lost index.json.",
        ),
    ] = False,
) -> None:
    """List the trained classes and the enrolled objects: number of views, source and date of enrolment."""
    from thor2_jax.gallery.store import INDEX_FILE
    from thor2_jax.recognizer import Recognizer

    if gallery is not None and not (gallery / INDEX_FILE).is_file() and not (gallery / "objects").is_dir():
        raise InputError(f"gallery: {gallery} has no {INDEX_FILE}; expected the directory of a gallery")
    recognizer = Recognizer.load(model, gallery=gallery, reembed=reembed)
    table = Table("name", "views", "source", "enrolled")
    enrolled = recognizer.gallery.objects
    for name in recognizer.classes:
        sources, views, date = [], "", ""
        if name in recognizer.run.classes and name not in recognizer.gallery.hidden:
            sources.append("training")
        if name in enrolled:
            views, date = str(len(enrolled[name].clouds)), enrolled[name].date
            sources.append(enrolled[name].source)
        table.add_row(escape_characters(name), views, " and ".join(sources), date)
    console.print(table)
    finish(f"{model} knows {recognizer.model.union.summary}", "teach it", "enroll", "NAME", "FRAME", "--model", model)
