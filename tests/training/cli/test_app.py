"""Options of all commands, usage errors, progress, Ctrl-C, and compiled programs in the user's cache directory."""

import gc
import json
import os
import re
import shlex
import signal
import sys
import threading
import time
from pathlib import Path
from threading import Timer
from typing import Any
from unittest import mock

import pytest
from commands import Command, run_thor2
from image_files import write_frame
from processes import HANG, run_python
from refusals import assert_refused
from rich.progress import Progress
from small_runs import save_untrained_run
from typer.main import get_command

import thor2_jax as thor2
from training.cli.app import app, console, enable_compilation_cache, finish, show_progress
from training.cli.evaluate import _print_columns
from training.cli.options import FrameOptions
from training.storage.jobs import cache_directory, numbered

ROOT = Path(__file__).parents[3]


def test_closed_streams_are_no_error() -> None:
    command = "import os, sys; os.close(1); os.close(2); os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
    assert run_python("-c", command, "-m", "training.cli", "doctor", "--help").returncode == 0


def test_a_usage_error_is_one_line(refused: Command) -> None:
    for command, expected in (
        ("recognize", "--help"),
        ("trian", "--help"),
        ("train --out o --no-such-option", "--help"),
        ("evaluate coco d", "--help"),
        ("render --meshes m --out o --engine slurm", "--help"),
        ("recognize --model m f --workers 0", "(given: 0)"),
        ("recognize --model m f --workers=0", "(given: 0)"),
        ("recognize --model m f --depth-scale 0x10", "(given: 0x10)"),
        ("recognize --model '' f", "--model is empty"),
        ("recognize --model m f --out=", "--out is empty"),
        ("recognize --model m ''", "the argument after m is empty"),
        ("objects --model=~/m=", f"{Path.home()}/m= is not a run directory"),
        ("train --dataset m --out o --frames", "'--frames' requires an argument"),
        ("render --meshes m --out o --sensor --copies 100000000000000000000", "copies is 100000000000000000000;"),
        ("render --meshes m --out o --copies 3", "copies is 3; it belongs to an augmentation"),
        ("render --meshes m --out o --sensor --crops 99999999", "(given: 99999999)"),
    ):
        assert expected in refused(*shlex.split(command))


@pytest.mark.parametrize("command", ["recognize", "explain", "evaluate frames", "enroll mug", "doctor", "adapt"])
def test_frames_are_named_in_one_way(command: str, tmp_path: Path, refused: Command) -> None:
    out = ("--out", tmp_path / "out") if command in ("explain", "adapt") else ()
    for given, expected in (
        (("--bag", "absent.mcap"), "absent.mcap"),
        (("--bag", "b", "--color", "c.png"), "color is c.png and --bag is b"),
        (("frames", "a b", "--bag", "b"), "frames is frames, a b and --bag is b"),
        (("frames", "--every", 2), "every is 2; it belongs to --bag"),
        (("absent",), "absent"),
        (("--color", "c.png"), "--depth"),
    ):
        error = refused(*command.split(), *given, "--model", tmp_path / "run", *out)
        assert expected in error or (command == "evaluate frames" and "No such option: --" in error)


def test_the_next_command_has_the_same_frames(capsys: pytest.CaptureFixture[str]) -> None:
    given = FrameOptions(frames=[Path("a b"), Path("-c")], depth_scale=100.0, max_gap=0.5)
    finish("done", "see why", "explain", *given.arguments(), unknown_below=0.0, gallery=None, extend=True)
    line = capsys.readouterr().out
    assert line.startswith("done; see why with: thor2 explain ") and line.count("\n") == 1
    same = ["a b", "./-c", "--depth-scale", "100.0", "--max-gap", "0.5"]
    assert shlex.split(line)[-9:] == [*same, "--unknown-below", "0.0", "--extend"]
    assert FrameOptions(frames=[Path("a")] * 4).arguments() == ["FRAME"] and given.arguments(4)[0] == "FRAME"
    recording = FrameOptions(bag=Path("a.mcap"), every=2)
    for n_frames, every in ((3, "2"), (300, "600")):
        assert recording.arguments(n_frames) == ["--bag", "a.mcap", "--every", every]


def test_a_loop_of_links_is_an_error(tmp_path: Path, refused: Command) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    for command in (("forget", "mug", "--model"), ("train", "--meshes", tmp_path, "--out")):
        assert str(tmp_path / "a") in refused(*command, tmp_path / "a")


def test_version_and_help(printed: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert printed("--version") == f"thor2 {thor2.__version__}\n"
    names = vars(get_command(app))["commands"]
    for arguments in ((), ("-h",), ("evaluate",), ("evaluate", "ocid", "-h"), *((name, "-h") for name in names)):
        text = printed(*arguments)
        assert "Usage:" in text and "…" not in text, arguments
    assert "--install-completion" in printed("--help")
    assert "[NAME] [FRAME]..." in printed("enroll", "--help") and "[[" not in printed("evaluate", "uwis", "--help")
    assert "{" not in printed("train", "--help")  # values of the protocols are filled in


def test_a_narrow_terminal_cuts_no_column(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    code = "import sys; sys.stdout.isatty = lambda: True; from training.cli.app import *; print(console.width)"
    code += "; console.print(Table('CE+TOPS+TOPS2'), width=12)"
    code += "; shown = Table('name', 'views'); shown.add_row('x' * 99, '120'); console.print(shown)"
    width, *table = run_python("-c", code).stdout.splitlines()
    assert width == "72" and "".join(table).count("TOPS") == 2 and "…" not in "".join(table)
    assert "".join(table).count("x") == 99 and "120" in "".join(table)


def test_wide_tables_are_split(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "_width", 80)
    rows = [["all", *(f"0.{n} ± 0.012" for n in range(700, 712))], ["by light", *[""] * 12]]
    _print_columns(["", *(f"method-{n} (thor2 recognize)" for n in range(12))], rows, "accuracy")
    out = capsys.readouterr().out
    assert all(value in out for value in rows[0]) and out.count("by light") == out.count("accuracy") == 3
    assert max(map(len, out.splitlines())) <= 80
    _print_columns(["", "method"], [["x" * 97, "0.712"]], "accuracy")
    assert "0.712" in capsys.readouterr().out


def test_text_is_not_broken_into_lines(capsys: pytest.CaptureFixture[str]) -> None:
    console.print("word " * 99)
    assert capsys.readouterr().out.count("\n") == 1


def test_objects_without_jax_or_all_characters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    description = {"format": 2, "descriptor_version": thor2.DESCRIPTOR_VERSION, "classes": ["t\xe9"]}
    (tmp_path / "run.json").write_text(json.dumps(description))
    code = (
        "import training.cli, thor2_jax, sys; assert not {'jax', 'scipy'} & {*sys.modules};"
        "import thor2_jax.service.preparation\ntry: training.cli.main()\n"
        "except SystemExit as end: assert not end.code and 'jax' not in sys.modules"
    )
    done = run_python("-c", code, "objects", "--model", tmp_path)
    assert done.returncode == 0 and r"1 object: t\xe9" in done.stdout, done.stderr


def test_public_names_are_imported_when_used() -> None:
    assert set(thor2.__all__) <= set(dir(thor2))
    for name in thor2.__all__:
        assert getattr(thor2, name) is not None
    assert thor2.capacity.POINT_BUCKETS and thor2.export.export_recognizer
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = thor2.no_such_name


def test_errors_show_control_characters_escaped(tmp_path: Path, refused: Command) -> None:
    err = refused("train", "--meshes", tmp_path / "a\x1b[2Jb\u202ec", "--out", tmp_path / "run")
    assert "\x1b" not in err and "\u202e" not in err and r"a\x1b[2Jb\u202ec" in err


def test_install_commands_are_those_of_the_documentation() -> None:
    commands = {
        match
        for path in [*ROOT.glob("thor2_jax/**/*.py"), *ROOT.glob("training/**/*.py"), *ROOT.glob("docs/*.md")]
        for match in re.findall(r"pip install [^`\n]*?'[^']*\[\w+\]'", path.read_text())
    }
    assert commands and all(re.fullmatch(r"pip install -c constraints.txt (-e )?'\.\[\w+\]'", c) for c in commands)


def test_ctrl_c_while_commands_are_imported() -> None:
    code = """
import sys

class Interrupt:
    def find_spec(self, name, *_):
        if name == "training.cli.doctor":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Interrupt())
import training.cli
"""
    done = run_python("-c", code)
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize(("workers", "number"), [("1", signal.SIGHUP), ("1", signal.SIGTERM), ("2", signal.SIGTERM)])
def test_a_signal_leaves_no_warning_nor_files(workers: str, number: signal.Signals, tmp_path: Path) -> None:
    code = """
import os, signal, sys
import training.cli
from thor2_jax.files import temporary_directory
from training.storage.workers import local_workers

def command(**_):
    with temporary_directory(sys.argv[1]):
        results = local_workers(int(sys.argv[2]))(eval, ["1", "__import__('time').sleep(10_000)"])
        next(results)
        os.kill(os.getpid(), int(sys.argv[3]))

sys.modules["training.cli.app"].app = command
signal.signal(int(sys.argv[3]), signal.SIG_DFL)  # under nohup, it is ignored
sys.modules["training.cli.app"].main()
"""
    done = run_python("-c", code, tmp_path, workers, int(number))
    assert (done.returncode, done.stderr) == (-number, "")
    assert not os.listdir(tmp_path)


def test_a_second_ctrl_c_ends_the_exit_without_a_traceback() -> None:
    code = """
import atexit, signal, sys
import training.cli
signal.signal(signal.SIGINT, signal.default_int_handler)  # in a background job, it is ignored
sys.modules["training.cli.app"].app = lambda **_: atexit.register(signal.raise_signal, signal.SIGINT) and 130
sys.modules["training.cli.app"].main()
"""
    done = run_python("-c", code)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("no backend"), thor2.InputError("damaged")])
def test_platforms_that_jax_lacks_are_named(error: Exception, refused: Command, monkeypatch: Any) -> None:
    monkeypatch.setenv("JAX_PLATFORMS", "absent")
    for module, name in (("jax", "devices"), ("training.cli.app", "app")):
        monkeypatch.setattr(sys.modules[module], name, mock.Mock(side_effect=error))
    assert "JAX_PLATFORMS is absent" in refused("demo")


class Finalized:
    """An object whose finalizer is interrupted."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGINT)


def collect_garbage() -> None:
    """Collect garbage, with a callback that is interrupted, as JAX's may be."""

    def callback(*_: object) -> None:
        gc.callbacks.remove(callback)
        signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(callback)
    gc.collect()


@pytest.mark.parametrize("interrupted", [Finalized, collect_garbage])
@pytest.mark.parametrize("busy", [False, True], ids=["", "busy"])
def test_ctrl_c_where_exceptions_are_ignored(interrupted: Any, busy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine, the repeated signal may arrive before the handler of the lost one has ended."""

    def run(**_: object) -> None:
        interrupted()
        time.sleep(HANG)

    def timer(seconds: float, *arguments: Any) -> threading.Timer:
        return Timer(0 if busy and seconds == 0.01 else seconds, *arguments)

    monkeypatch.setattr("threading.Timer", timer)
    monkeypatch.setattr(sys.modules["training.cli.app"], "app", run)
    with pytest.raises(KeyboardInterrupt):
        run_thor2("demo")


# Progress on a standard error that is not a terminal, or on a terminal that cannot move its cursor.


@pytest.mark.parametrize("is_terminal", [False, True])
def test_lines_come_every_few_seconds(is_terminal: bool, capsys: Any, monkeypatch: Any) -> None:
    now = [100.0]
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: is_terminal)
    monkeypatch.setattr("training.storage.jobs.time.monotonic", lambda: now[0])
    with show_progress(quiet=True) as show:
        show("render", 0, 10, "")
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
    assert lines[4] == "describe: 20 of 40, 20 s, about 20 s left, views"


def test_stages_are_numbered_and_the_time_left_is_that_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("training.storage.jobs.time.monotonic", lambda: now[0])
    shown: list[tuple[str, int, int, str]] = []
    show = numbered(lambda *values: shown.append(values), {"render": 1.0, "cached": 0.0, "fit": 4.0, "write": 2.0})
    calls = [("render", 0, 0), ("render", 2, 10), ("cached", 1, 50), ("fit", 1, 20), ("fit thor", 1, 9), ("fit", 2, 10)]
    calls += [("write", 0, 1), ("write", 2, 10)]
    for stage, done, seconds in calls:  # The fit is resumed after one of four epochs.
        now[0] += seconds
        show(stage, done, 4 if stage == "fit" else 2, "loss 1" if stage == "fit" else "")
    assert shown == [
        ("stage 1 of 4: render", 0, 2, ""),
        ("stage 1 of 4: render", 2, 2, "about 60 s left of all stages"),
        ("stage 2 of 4: cached", 1, 2, ""),
        ("stage 3 of 4: fit", 1, 4, "loss 1, about 50 s left of all stages"),
        ("fit thor", 1, 2, ""),
        ("stage 3 of 4: fit", 2, 4, "loss 1, about 58 s left of all stages"),
        ("stage 4 of 4: write", 0, 2, "about 29 s left of all stages"),
        ("stage 4 of 4: write", 2, 2, ""),
    ]


def test_a_narrow_terminal_gets_bars(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The note is cut, then the bar and the name of the stage, not the numbers."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    long = "stage 3 of 9: fold 0: describe for the embedding"
    for width, stage, done, total, note in (
        (80, "render [red]", 3, 10, "of [/x]"),
        (80, "stage 4 of 5: fit networks", 20, 104, "epoch 2/2, loss 5.407, accuracy 0.338, 7,336 samples/s" * 2),
        (50, long, 11720, 12960, ""),
    ):
        monkeypatch.setenv("COLUMNS", f"{width}")
        with show_progress() as show:
            show(stage, done, total, note)
        err = capsys.readouterr().err
        assert "━" in err and stage[: width - 38] in err and f"{done}/{total}" in err and note[:7] in err


def test_the_running_stage_is_within_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A live display is cut at the height of the terminal."""
    bars: list[Progress] = []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("LINES", "10")
    whole = Progress.__init__
    monkeypatch.setattr(Progress, "__init__", lambda self, *a, **k: (bars.append(self), whole(self, *a, **k))[1])
    with show_progress() as show:
        for number in range(30):
            show(f"stage {number}", 1, 2, "")
        visible = [task.description for task in bars[0].tasks if task.visible]
    assert visible[-1] == "stage 29" and 5 < len(visible) < 10


# Compiled programs.


@pytest.fixture
def environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An environment without a cache, and a user's cache directory."""
    for name in list(os.environ):
        if name.startswith(("JAX_", "THOR2_")):
            monkeypatch.delenv(name)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    return tmp_path / "home" / "thor2-jax" / "xla"


def test_the_cache_can_be_moved_or_disabled(environment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A directory that cannot be created or accessed is ignored, and a file is refused."""
    for value in ("off", "/proc/no-such-directory", "x" * 300):
        monkeypatch.setenv("THOR2_CACHE", value)
        enable_compilation_cache()
        assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "" and not environment.exists()
    (tmp_path / "file").touch()
    monkeypatch.setenv("THOR2_CACHE", str(tmp_path / "file"))
    assert_refused("THOR2_CACHE", enable_compilation_cache)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("THOR2_CACHE", "~/elsewhere")
    enable_compilation_cache()
    assert Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).parent == tmp_path / "elsewhere"
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/mine")  # one of the environment is left alone
    enable_compilation_cache()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "/mine" and not environment.exists()
    monkeypatch.setattr("os.environ", {})
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # a user without a home directory
    assert cache_directory("xla") is None


@pytest.mark.slow
def test_a_second_recognition_compiles_nothing(environment: Path, tmp_path: Path) -> None:
    frame = write_frame(tmp_path / "frame", {1: "brick"})
    save_untrained_run(tmp_path / "run", ("brick", "stick"), ("tops", "tops2"))

    def recognize() -> tuple[set[str], str]:
        """Return the names of the cached programs, and what was printed."""
        done = run_python("-m", "training.cli", "recognize", "--model", tmp_path / "run", frame)
        assert done.returncode == 0 and done.stderr == ""
        return {path.name for path in environment.glob("*/*-cache")}, done.stdout

    first = recognize()
    assert len(first[0]) > 5 and recognize() == first
