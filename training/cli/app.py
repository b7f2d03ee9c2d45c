"""The typer application and what its commands share: the console, progress bars and option types.

Invalid input ends a command with one line on standard error and exit code 2.
"""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from thor2_jax.errors import InputError

__all__ = ["ModelOption", "UnknownOption", "app", "console", "main", "progress_bars", "split_names"]

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Recognize objects on cluttered tables in RGB-D frames, trained on synthetic views only (THOR2 in JAX).",
)
# Without a terminal, rich would truncate tables at 80 columns.
console = Console(width=None if sys.stdout.isatty() else 160)

UnknownOption = Annotated[
    float,
    typer.Option("--unknown-below", help="Instances with a lower confidence are unknown objects (0 to 1)."),
]
ModelOption = Annotated[Path, typer.Option("--model", help="Run directory of a trained model.")]


@contextlib.contextmanager
def progress_bars() -> Iterator[Callable[[str, int, int, str], None]]:
    """Yield a callback (stage, done, total, note) that shows one progress bar per stage on standard error."""
    tasks: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=Console(stderr=True),
    ) as bars:

        def show(stage: str, done: int, total: int, note: str) -> None:
            if stage not in tasks:
                # A resumed stage starts at what is already done, so that the remaining time is estimated correctly.
                tasks[stage] = bars.add_task(stage, total=total, completed=done, note=note)
            bars.update(tasks[stage], completed=done, total=total, note=note)

        yield show


def split_names(names: str) -> list[str]:
    """Return the entries of a comma-separated option."""
    return [name.strip() for name in names.split(",")] if names else []


def main() -> None:
    """Run the command line (entry point of the console script)."""
    try:
        app(standalone_mode=True)
    except InputError as error:
        _exit_with(str(error))
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _exit_with(f"{where}{error.strerror or error}")


def _exit_with(message: str) -> None:
    print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
    raise SystemExit(2)
