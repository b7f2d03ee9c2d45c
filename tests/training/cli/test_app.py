"""Options of all commands, and usage errors."""

import gc
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax  # noqa: F401  (its callback of the garbage collection)
import pytest
from helpers import Command
from processes import HANG

import thor2_jax as thor2
from training.cli.app import _interrupt, finish
from training.cli.options import FrameOptions

ROOT = Path(__file__).parents[3]


def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    command, environment = [sys.executable, "-c", *arguments], os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=HANG)


def test_a_usage_error_is_one_line(refused: Command) -> None:
    for command, expected in (
        ("recognize", "--help"),
        ("trian", "--help"),
        ("train --out o --no-such-option", "--help"),
        ("evaluate frames", "--help"),
        ("evaluate coco d", "--help"),
        ("render --meshes m --out o --engine slurm", "--help"),
        ("recognize --model m f --workers 0", "(given: 0)"),
        ("recognize --model m f --workers=0", "(given: 0)"),
        ("recognize --model m f --depth-scale 0x10", "(given: 0x10)"),
        ("recognize --model '' f", "--model is empty"),
        ("recognize --model m f --out=", "--out is empty"),
        ("recognize --model m ''", "the argument after m is empty"),
        ("explain '' --model m --out o", "the argument after explain is empty"),
        ("render --meshes m --out o --sensor --copies 100000000000000000000", "copies is 100000000000000000000;"),
        ("render --meshes m --out o --sensor --copies 0", "copies is 0; expected"),
        ("render --meshes m --out o --sensor --crops 99999999", "crops is 99999999; expected"),
    ):
        assert expected in refused(*shlex.split(command))


@pytest.mark.parametrize("command", ["recognize", "explain", "evaluate frames", "enroll mug", "doctor", "adapt"])
def test_frames_are_named_in_one_way(command: str, tmp_path: Path, refused: Command) -> None:
    out = ("--out", tmp_path / "out") if command in ("explain", "adapt") else ()
    for given, expected in (
        (("--bag", "absent.mcap"), "absent.mcap"),
        (("--bag", "b", "--color", "c.png"), "color is c.png and bag is b"),
        (("frames", "--every", 2), "every is 2; it belongs to --bag"),
        (("absent",), "absent"),
        (("--color", "c.png"), "c.png" if command == "enroll mug" else "--depth"),
    ):
        assert expected in refused(*command.split(), *given, "--model", tmp_path / "run", *out)


def test_the_next_command_has_the_same_frames(capsys: pytest.CaptureFixture[str]) -> None:
    given = FrameOptions(frames=[Path("a b"), Path("c")], depth_scale=100.0, max_gap=0.5)
    finish("done", "see why", "explain", *given.arguments)
    line = capsys.readouterr().out
    assert line.startswith("done; see why with: thor2 explain ") and line.count("\n") == 1
    assert shlex.split(line)[-6:] == ["a b", "c", "--depth-scale", "100.0", "--max-gap", "0.5"]


def test_a_loop_of_links_is_an_error(tmp_path: Path, refused: Command) -> None:
    (tmp_path / "a").symlink_to("b")
    (tmp_path / "b").symlink_to("a")
    assert str(tmp_path / "a") in refused("forget", "mug", "--model", tmp_path / "a")


def test_version(printed: Command) -> None:
    assert printed("--version") == f"thor2 {thor2.__version__}\n"


def test_short_help(printed: Command) -> None:
    for arguments in ((), ("-h",), ("evaluate",), ("train", "-h")):
        assert "Usage:" in printed(*arguments)
    assert "--install-completion" in printed("--help")
    assert "{" not in printed("train", "--help")  # values of the protocols are filled in


def test_help_objects_and_preparation_import_no_jax(tmp_path: Path) -> None:
    description = {"format": 2, "descriptor_version": thor2.DESCRIPTOR_VERSION, "classes": ["mug"]}
    (tmp_path / "run.json").write_text(json.dumps(description))
    code = (
        "import training.cli, thor2_jax, sys; assert not {'jax', 'scipy'} & {*sys.modules};"
        "import thor2_jax.service.preparation;"
        "sys.exitfunc = None\ntry: training.cli.main()\n"
        "except SystemExit as end: assert not end.code and 'jax' not in sys.modules"
    )
    done = run_python(code, "objects", "--model", str(tmp_path))
    assert done.returncode == 0 and "1 object: mug" in done.stdout, done.stderr


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
    done = run_python(code)
    assert (done.returncode, done.stderr) == (130, "")


def test_ctrl_c_in_a_callback_of_jax() -> None:
    """JAX ignores exceptions there, so Ctrl-C takes effect after it."""
    reached = []

    def _xla_gc_callback() -> None:
        something_called()
        reached.append(True)

    def something_called() -> None:
        signal.raise_signal(signal.SIGINT)

    assert "_xla_gc_callback" in {callback.__name__ for callback in gc.callbacks}
    previous = signal.signal(signal.SIGINT, _interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            _xla_gc_callback()
            time.sleep(HANG)
    finally:
        signal.signal(signal.SIGINT, previous)
    assert reached
