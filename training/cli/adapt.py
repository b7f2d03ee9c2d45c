"""`thor2 adapt`: correct the colours of a camera, from frames without names."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli import options
from training.cli.app import app, console, finish, show_progress


@app.command()
@options.grouped_options
def adapt(
    model: options.ModelOption,
    given: options.FrameOptions,
    out: Annotated[Path, typer.Option(help="Directory for the adapted run, which is used like the original.")],
    segment: options.SegmentOption = None,
    quiet: options.QuietOption = False,
) -> None:
    """Adapt a run to a camera: correct its colours before recognition.

    All frames must be from one camera. They need instance masks (or --segment) but no names, and may contain unknown
    objects. The warmth (red against blue) is estimated from at least ten instances, preferably of many objects: it is
    the value that minimizes the uncertainty of the model's answers.
    """
    from training.camera_adaptation import adapt_run
    from training.storage.jobs import of_stage

    sources = given.sources(segment)
    with show_progress(quiet) as progress:
        adaptation = adapt_run(model, sources, out, of_stage(progress, "adapt"))
    console.print(f"warmth: {adaptation.transform.warmth:+.3f}")
    console.print(
        f"instances: {adaptation.instances}; mean uncertainty of their answers {adaptation.uncertainty_before:.3f} "
        f"before, {adaptation.uncertainty_after:.3f} after"
    )
    if adaptation.uncertainty_after >= adaptation.uncertainty_before:
        console.print("these frames do not show that a correction is needed; a run without one may serve as well")
    finish(f"written to {out}", "recognize a frame", "recognize", "FRAME", model=out)
