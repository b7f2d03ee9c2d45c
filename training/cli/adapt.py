"""`thor2 adapt`: correct the colours of a camera, from frames without names."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli.app import ModelOption, QuietOption, app, console
from training.cli.progress import show_progress


@app.command()
def adapt(
    model: ModelOption,
    frames: Annotated[list[Path], typer.Argument(metavar="FRAME...", help="Folders of frames of one camera.")],
    out: Annotated[Path, typer.Option(help="Directory for the adapted run, which recognizes as the model does.")],
    segment: Annotated[
        str | None, typer.Option(help="Segment the frames instead of reading labels: table, or another segmenter.")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Adapt a run to a camera: its colours are corrected before recognition.

    The frames need instance masks (or --segment) and no names; unknown objects may be among them. The warmth (red
    against blue) is estimated from at least ten instances, best of many objects: with it, the model is most certain of
    its answers.
    """
    from thor2_jax.segmentation.segmenters import load_segmenter
    from training.camera_adaptation import adapt_run
    from training.readers.frame_files import find_frames, segmented_source

    sources = find_frames(frames)
    if segment is not None:
        segmenter = load_segmenter(segment)
        sources = [segmented_source(source, segmenter) for source in sources]
    with show_progress(quiet) as progress:
        adaptation = adapt_run(model, sources, out, lambda done, total: progress("adapt", done, total, ""))
    console.print(f"warmth: {adaptation.transform.warmth:+.3f}")
    console.print(
        f"{adaptation.instances} instances; mean uncertainty of their answers {adaptation.uncertainty_before:.3f} "
        f"before, {adaptation.uncertainty_after:.3f} after"
    )
    console.print(f"written to {out}")
