"""Progress on a standard error that is not a terminal, and without standard error."""

import sys
from typing import Any

import pytest

from training.cli.app import show_progress
from training.storage.jobs import numbered


def test_lines_come_every_few_seconds(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("training.storage.jobs.time.monotonic", lambda: now[0])
    with show_progress() as show:
        for done in range(41):
            show("describe", done, 40, "views")
            now[0] += 1
        show("describe", 40, 40, "views")
        show("fit", 7, 9, "")
    err = capsys.readouterr().err
    lines = err.splitlines()
    assert "\x1b" not in err and "\r" not in err
    assert lines[0] == "describe: 0 of 40, views" and lines[-1] == "fit: 7 of 9"
    assert len(lines) == 2 + 40 // 5  # one at the start of each stage, and one every five seconds
    assert "20 of 40" in lines[4] and "20 s left" in lines[4]


def test_stages_are_numbered_and_the_time_left_is_that_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("training.storage.jobs.time.monotonic", lambda: now[0])
    shown: list[tuple[str, int, int, str]] = []
    show = numbered(lambda *values: shown.append(values), {"render": 1.0, "cached": 0.0, "fit": 4.0})
    calls = [("render", 0, 0), ("render", 2, 10), ("cached", 1, 50), ("fit", 1, 20), ("fit thor", 1, 9), ("fit", 2, 10)]
    for stage, done, seconds in calls:  # The fit is resumed after one of four epochs.
        now[0] += seconds
        show(stage, done, 4 if stage == "fit" else 2, "loss 1" if stage == "fit" else "")
    assert shown == [
        ("stage 1 of 3: render", 0, 2, ""),
        ("stage 1 of 3: render", 2, 2, "about 40 s left of all stages"),
        ("stage 2 of 3: cached", 1, 2, ""),
        ("stage 3 of 3: fit", 1, 4, "loss 1, about 30 s left of all stages"),
        ("fit thor", 1, 2, ""),
        ("stage 3 of 3: fit", 2, 4, "loss 1, about 38 s left of all stages"),
    ]


def test_a_line_is_written_at_once_unless_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    for quiet, expected in ((False, "render: 0 of 10\n"), (True, "")):
        with show_progress(quiet=quiet) as show:
            show("render", 0, 10, "")
            assert capsys.readouterr() == ("", expected)


def test_a_terminal_gets_bars(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with show_progress() as show:
        show("render [red]", 3, 10, "of [/x]")
    err: Any = capsys.readouterr().err
    assert "━" in err and "render [red]" in err and "3/10" in err and "of [/x]" in err
