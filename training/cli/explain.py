"""`thor2 explain`: explain the answers for instances."""

import functools
from pathlib import Path
from typing import Annotated

import typer

from thor2_jax.errors import InputError, with_context
from training.cli import options
from training.cli.app import app, console, finish, print_note, show_progress


@app.command()
@options.grouped_options
def explain(
    model: options.ModelOption,
    given: options.FrameOptions,
    out: Annotated[Path, typer.Option(help="Directory; a page is <frame>/<instance>/explanation.html in it.")],
    instance: Annotated[
        list[int] | None, typer.Option(help="Label number of an object; repeatable. Default: all.")
    ] = None,
    segment: options.SegmentOption = None,
    unknown_below: options.UnknownOption = None,
    answer_by: options.AnswerByOption = None,
    gallery: options.GalleryOption = None,
    quiet: options.QuietOption = False,
) -> None:
    """Explain answers by decisive points, slices, colours, smallest changes and nearest views.

    For each instance, this command writes a page with its pictures, the same pictures as PNG, and explanation.json.
    """
    from thor2_jax.explanation.explain import explain as explain_answer
    from thor2_jax.files import check_output_directory
    from thor2_jax.segmentation.segmenters import MODEL
    from training.frame_recognition import RecognizerArguments
    from training.reports.explanation_page import PAGE, check_no_foreign_files, write_explanation

    load = functools.cache(RecognizerArguments(model, unknown_below, answer_by, gallery).load)
    sources = given.sources(segment, lambda frame: load().segment(frame))
    names = [source.name for source in sources]
    names += [str(page.relative_to(out)) for depth in ("*/*", "*/*/*") for page in out.glob(f"{depth}/{PAGE}")]
    check_output_directory(out, resumable={name.split("/")[0] for name in names})
    recognizer = load()
    explained, last = 0, 0
    with show_progress(quiet, prints=True) as progress:
        for number, source in enumerate(sources, 1):
            with with_context(source.name):
                frame = source.read()
                labels = frame.instances if instance is None else instance
            if not labels:
                print_note(f"skipped: {source.name}: it has no instances")
            for done, label in enumerate(labels):
                directory = out / source.name / str(label)
                check_no_foreign_files(directory)
                progress(f"explain frame {number} of {len(sources)}", done, len(labels), f"instance {label}")
                try:
                    explanation = explain_answer(recognizer, frame, label)
                except InputError as error:
                    if instance is not None:
                        raise InputError(f"{source.name}: {error}") from None
                    print_note(f"skipped: {source.name}: {error}")
                    continue
                write_explanation(explanation, frame, source.name, directory)
                explained, last = explained + 1, label
                console.print(f"{explanation.title}: {directory / PAGE}", soft_wrap=True)
    if not explained:
        raise InputError("no instance could be explained; see above")
    pages = f"pages in {out}: {explained}"
    if segment == MODEL:  # enrolling does not accept labels that depend on the model
        finish(pages, "list the objects of the model", "objects", model=model, gallery=gallery)
    else:
        purpose = "if a name is wrong, add this view of the object"
        # In several frames, the same label number is of different objects.
        command = "enroll", "NAME", *(given.arguments() if len(sources) == 1 else ["FRAME"])
        finish(pages, purpose, *command, segment=segment, instance=last, model=model, gallery=gallery, extend=True)
