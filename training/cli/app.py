"""The typer application and what its commands share: the console and option types.

Invalid input ends a command with one line on standard error and exit code 2.
"""

import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from typer.core import TyperCommand

from thor2_jax import __version__
from thor2_jax.errors import InputError
from thor2_jax.printable import escape_characters
from training.cli.compilation_cache import enable_compilation_cache

__all__ = [
    "GalleryOption",
    "ManyFrames",
    "MeshScaleOption",
    "ModelOption",
    "QuietOption",
    "UnknownOption",
    "app",
    "console",
    "main",
    "show_help",
    "split_names",
]

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    help="Recognize objects on cluttered tables in RGB-D frames, trained on synthetic views only (THOR2 in JAX).",
)
# Without a terminal, rich would truncate tables at 80 columns. Names of objects may look like markup.
console = Console(width=None if sys.stdout.isatty() else 160, markup=False, emoji=False)

UnknownOption = Annotated[
    float | None,
    typer.Option(
        "--unknown-below",
        help="Instances with a lower confidence are unknown objects (0 to 1). Default: the model's own for trained "
        "classes; for enrolled objects, 0.26 with one view to 0.37 with 10.",
    ),
]
ModelOption = Annotated[Path, typer.Option("--model", help="Run directory of a trained model.")]
GalleryOption = Annotated[
    Path | None, typer.Option("--gallery", help="Directory of the gallery. Default: gallery in the run directory.")
]
MeshScaleOption = Annotated[
    float, typer.Option("--mesh-scale", help="Factor from the unit of the meshes to metres; 0.001 for millimetres.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]


class ManyFrames(TyperCommand):
    """A command whose option --frames takes all values up to the next option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with --frames before each value that follows it."""
        expanded: list[str] = []
        taking = False
        for argument in args:
            if argument.startswith("-") and argument != "-":
                taking = argument == "--frames"
                expanded += [] if taking else [argument]
            else:
                expanded += ["--frames", argument] if taking else [argument]
        return super().parse_args(ctx, expanded)


TRAINING_PACKAGES = ("colour", "embreex", "gudhi", "kmapper", "sklearn")
"""Packages that recognition and the service do not import (docs/install.md)."""


def show_help(context: typer.Context) -> None:
    """Print the help of a group of commands if none of them is given."""
    if context.invoked_subcommand is None:
        print(context.get_help(), end="")


def _show_version(requested: bool) -> None:
    if requested:
        print(f"thor2 {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def thor2(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    show_help(context)


def split_names(names: str) -> list[str]:
    """Return the entries of a comma-separated option."""
    return [name.strip() for name in names.split(",")] if names else []


def main() -> None:
    """Run the command line (entry point of the console script)."""
    try:
        enable_compilation_cache()
        status = app(standalone_mode=False)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        advice = f"; see {context.command_path} --help" if context else ""
        _exit_with(error.format_message().rstrip(".") + advice)
    except InputError as error:
        _exit_with(str(error))
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in TRAINING_PACKAGES:
            raise
        _exit_with(f"{package} is not installed; recognition works without it, this does not: see docs/install.md")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _exit_with(f"{where}{error.strerror or error}")
    raise SystemExit(status)


def _exit_with(message: str) -> NoReturn:
    print(f"error: {escape_characters(' '.join(message.split()))}", file=sys.stderr)
    raise SystemExit(2)
