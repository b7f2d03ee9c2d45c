"""The command line in this process: its arguments and its output."""

import json
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

Command = Callable[..., str]
"""Type of the fixtures `printed` and `refused`, which run the command line."""

Texts = Callable[..., tuple[str, str]]
"""Type of the fixture `texts`, which runs the command line and returns its standard output and error."""

Recognize = Callable[..., list[dict[str, Any]]]
"""Type of the fixture `recognize`, which recognizes frames on the command line."""


STEPS = ("--azimuth-step", 180, "--polar-step", 90, "--workers", 1)
"""Options of `thor2 render` and `train`: few views, rendered in one process."""


def run_thor2(*arguments: object) -> int:
    """Run the command line in this process and return its exit status."""
    from training import cli

    with mock.patch.object(sys, "argv", ["thor2", *map(str, arguments)]):
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # see `tests/conftest.py`
    return 0


def frame_options(folder: Path, **changes: object) -> list[object]:
    """Return the options of `thor2 recognize` that name the files of a frame, with some changed."""
    names = {"color": "color.png", "depth": "depth.png", "labels": "mask.png", "intrinsics": "intrinsics.json"}
    files = {option: folder / name for option, name in names.items()}
    return [part for name, value in {**files, **changes}.items() for part in (f"--{name}", value)]


def json_lines(text: str) -> list[dict[str, Any]]:
    """Return the values of a JSON Lines text."""
    return [json.loads(line) for line in text.splitlines()]
