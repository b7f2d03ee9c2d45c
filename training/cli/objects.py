"""`thor2 objects`: list the objects that a run recognizes."""

import dataclasses
from typing import Annotated

import typer

from thor2_jax.printable import escape_characters
from training.cli import options
from training.cli.app import Table, app, console, finish, show_progress


@app.command()
def objects(
    model: options.ModelOption,
    gallery: options.GalleryOption = None,
    reembed: Annotated[
        bool,
        typer.Option(
            "--reembed",
            help="Compute the embeddings of all enrolled views again, after a change of the embedding, and restore a "
            "lost index.json.",
        ),
    ] = False,
    quiet: options.QuietOption = False,
) -> None:
    """List the trained classes and the enrolled objects: number of views, source and date of enrollment."""
    from thor2_jax.gallery.store import GALLERY_DIRECTORY, check_exists, load_gallery
    from thor2_jax.model.run_record import read_description

    check_exists(gallery)
    directory = model / GALLERY_DIRECTORY if gallery is None else gallery
    if reembed:
        from thor2_jax.gallery.enrollment import ObjectGallery
        from thor2_jax.model.run_directory import load_run
        from training.storage.jobs import of_stage

        run = load_run(model)
        with show_progress(quiet) as progress:
            ObjectGallery(run.classes, run.embedding).open(directory, reembed=True, report=of_stage(progress, "embed"))
    description = read_description(model)
    trained, embedding = tuple(description["classes"]), description.get("embedding")
    stored = load_gallery(directory, None if embedding is None else str(embedding))
    known = dataclasses.replace(stored, trained=trained)
    table = Table("name", "views", "source", "enrolled")
    for number, name in enumerate(known.answered_names):
        sources, views, date = ["training"] if known.has_output[number] else [], "", ""
        if name in known.objects:
            views, date = str(len(known.objects[name].clouds)), known.objects[name].date
            sources.append(known.objects[name].source)
        table.add_row(escape_characters(name), views, " and ".join(sources), date)
    console.print(table)
    result = f"{gallery or model} recognizes {known.summary}"
    finish(result, "enroll an object", "enroll", "NAME", "FRAME", model=model, gallery=gallery)
