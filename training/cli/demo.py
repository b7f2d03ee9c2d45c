"""`thor2 demo`: train and recognize without any download."""

from pathlib import Path
from typing import Annotated

import typer

from training.cli import options
from training.cli.app import Table, app, console, finish, show_progress


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Directory for the report, its pictures and the trained run.")] = Path(
        "demo-report"
    ),
    seed: Annotated[int, typer.Option(help="Seed for the training and the scenes.")] = 0,
    quiet: options.QuietOption = False,
) -> None:
    """Train on built-in objects, recognize cluttered scenes of them and write a report; no download, a few minutes.

    An interrupted demo resumes.
    """
    from training.demo import run_demo
    from training.storage.workers import keep_freed_memory

    keep_freed_memory()
    with show_progress(quiet) as progress:
        figures = run_demo(out, seed, progress, workers=2)
    table = Table("", *figures.names)
    for part, values in figures.accuracy.items():
        table.add_row(part, *(f"{v:.3f}" for v in values))
    console.print(table)
    finish(f"report: {out / 'report.html'}", "try its model in a browser", "serve", model=out / "run")
