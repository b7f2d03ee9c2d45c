"""`thor2 objects`: list the objects that a run recognizes."""

from typing import Annotated

import typer
from rich.table import Table

from thor2_jax.printable import escape_characters
from training.cli.app import ModelOption, app, console


@app.command()
def objects(
    model: ModelOption,
    reembed: Annotated[
        bool, typer.Option("--reembed", help="Embed all enrolled views again, after a change of the embedding.")
    ] = False,
) -> None:
    """List the trained classes and the enrolled objects: number of views, source and date of enrolment."""
    from thor2_jax.recognizer import Recognizer

    recognizer = Recognizer.load(model, reembed=reembed)
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
