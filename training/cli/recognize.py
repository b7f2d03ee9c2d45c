"""`thor2 recognize`: recognize the instances of one frame."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from thor2_jax.printable import escape_characters
from training.cli.app import ModelOption, UnknownOption, app, console


@app.command()
def recognize(
    model: ModelOption,
    color: Annotated[Path, typer.Option(help="Color image, PNG or JPEG.")],
    depth: Annotated[Path, typer.Option(help="Depth image, 16-bit PNG.")],
    labels: Annotated[Path, typer.Option(help="Instance labels, PNG; 0 is background.")],
    intrinsics: Annotated[Path, typer.Option(help="JSON with fx, fy, cx, cy (pixels) and optionally depth_scale.")],
    unknown_below: UnknownOption = 0.0,
    answer_by: Annotated[
        str | None, typer.Option(help="classifiers, gallery or both. Default: what the run has.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Directory for recognition.json and overlay.png.")] = None,
) -> None:
    """Recognize every instance of one RGB-D frame."""
    from thor2_jax.capacity import BATCH_BUCKETS
    from thor2_jax.files import check_output_directory, remove_leftovers
    from thor2_jax.recognition.frames import read_frame
    from thor2_jax.recognition.result_files import RESULT_FILES, write_recognitions
    from thor2_jax.recognizer import Recognizer

    if out is not None:
        check_output_directory(out, resumable=RESULT_FILES)
        remove_leftovers(out)
    frame = read_frame(color=color, depth=depth, labels=labels, intrinsics=intrinsics)
    recognizer = Recognizer.load(model, unknown_below, answer_by=answer_by)
    recognizer.chunk = BATCH_BUCKETS[-1]
    recognitions = recognizer.recognize(frame)
    table = Table("label", "name", "confidence", "classifier", "occluded", "points", "overflow", "note")
    for r in recognitions:
        confidence = "" if r.confidence is None else f"{r.confidence:.3f}"
        note = r.reason or ("outlier filter relaxed" if r.kept_by_fallback else "")
        name = escape_characters(r.name or "unrecognized")
        occluded = "yes" if r.occluded else "no"
        row = (str(r.label), name, confidence, r.classifier or "", occluded, str(r.points_used), str(r.overflow), note)
        table.add_row(*row)
    console.print(table)
    if out is not None:
        write_recognitions(out, frame, recognitions)
        console.print(f"written to {out}")
