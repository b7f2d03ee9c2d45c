"""Atomic writes, digests, the check of output directories, and tables in YAML files."""

import errno
import hashlib
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from failures import small_disk
from processes import HANG
from refusals import assert_refused
from written_files import files_of_the_user, killed

from thor2_jax import files


def test_text_is_utf_8_and_readable_by_all(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    files.write_text(str(path), "π\n")
    assert path.read_bytes() == b"\xcf\x80\n" and stat.S_IMODE(path.stat().st_mode) == 0o644
    files.write_text(path, os.fsdecode(b"frame \xff"))
    assert path.read_bytes() == b"frame \\udcff"
    with pytest.raises(FileNotFoundError):
        files.write_text(tmp_path / "missing" / "a.txt", "")
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_or_empty_directory_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    (tmp_path / "empty").mkdir()
    for directory in ("empty", "link", "new", "a/b/c"):
        files.check_output_directory(tmp_path / directory)
        files.check_output_directory(tmp_path / directory, "marker", ("partial",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "link"]


def test_a_used_directory_needs_a_marker(tmp_path: Path) -> None:
    for name in ("partial", ".lock", "marker"):
        (tmp_path / name).touch()
        assert_refused(f"out: {tmp_path} already contains", files.check_output_directory, tmp_path)
        if name != "marker":
            files.check_output_directory(tmp_path, "marker", ("partial",))
    assert_refused(
        f"out: {tmp_path} already contains marker", files.check_output_directory, tmp_path, "other", ("partial",)
    )
    files.check_output_directory(tmp_path, "marker")
    (tmp_path / "a").touch()
    assert_refused("contains .lock, a, ..., partial; expected", files.check_output_directory, tmp_path)


def test_files_links_and_unwritable_directories_are_refused(tmp_path: Path) -> None:
    """A full disk, too, is noticed before the work begins."""
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "absent")
    for name in ("file", "file/below", "link", "link/below"):
        assert_refused(f"out: {tmp_path / name} ", files.check_output_directory, tmp_path / name, "marker")
    assert_refused("File name too long", files.check_output_directory, tmp_path / ("x" * 300), "marker")
    with small_disk(500):
        assert_refused(f"out: {tmp_path}/new/deep .*large", files.check_output_directory, tmp_path / "new/deep")


def test_digests_are_those_of_earlier_versions() -> None:
    assert files.json_digest({"b": 1, "a": 2}) == hashlib.sha256(b'{"a": 2, "b": 1}').hexdigest()


def test_a_directory_appears_when_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "deeper" / "out"
    with pytest.raises(KeyError), files.atomic_directory(target) as unfinished:
        (unfinished / "half").write_text("x")
        raise KeyError
    for given, named in (((errno.ENOSPC, "full"), target), ((errno.EIO, "failed", "input"), "input")):
        with pytest.raises(OSError, match=f"'{re.escape(str(named))}'"), files.atomic_directory(target):
            raise OSError(*given)
    assert list(tmp_path.iterdir()) == []
    for content in ("first", "second"):
        with files.atomic_directory(target) as unfinished:
            assert content == "first" or (target / "file").read_text() == "first"
            (unfinished / "file").write_text(content)
        (target / "scan.ply").write_text("a user's")
    assert (target / "file").read_text() == "second"
    with pytest.raises(KeyError), files.atomic_directory(target):
        raise KeyError
    assert [path.name for path in target.parent.iterdir()] == ["out"] and (target / "file").read_text() == "second"
    assert (target / "scan.ply").read_text() == "a user's"
    (target / "folder").mkdir()
    with pytest.raises(IsADirectoryError), files.atomic_directory(target) as unfinished:
        for name in ("file", "folder"):
            (unfinished / name).write_text("third")
    assert (target / "file").read_text() == "second"


def test_only_leftovers_of_this_software_are_removed(tmp_path: Path) -> None:
    own, similar, link = killed(tmp_path), tmp_path / ".thor2-abcdefgh", tmp_path / ".thor2-link"
    users = [tmp_path / ".vimrc.original", tmp_path / ".report.ab12_xyz.json", similar / "scan.ply", similar / ".thor2"]
    link.symlink_to(killed(tmp_path.parent))
    with files_of_the_user(*users):
        files.remove_leftovers(tmp_path)
        files.remove_leftovers(tmp_path / "missing")
    assert (link / "half").exists() and not own.exists()


def test_the_next_write_removes_what_a_killed_process_left(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\nfrom colornet.files import atomic_write\n"
        "with atomic_write(sys.argv[1]) as file:\n    file.touch()\n    os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "a.txt"], timeout=HANG)
    (left,) = tmp_path.iterdir()
    assert done.returncode == -signal.SIGKILL and left.name.startswith(".thor2-")
    with files.temporary_directory(tmp_path) as running:
        files.write_text(tmp_path / "b.txt", "")
        assert {path.name for path in tmp_path.iterdir()} == {running.name, "b.txt"} and list(running.iterdir())


def test_an_interrupted_removal_can_be_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(path: Path, **options: Any) -> None:
        rmtree(path, **options)
        raise KeyboardInterrupt

    rmtree = shutil.rmtree
    with pytest.raises(KeyboardInterrupt), files.temporary_directory(tmp_path) as directory:
        (directory / "views").mkdir()
        monkeypatch.setattr("shutil.rmtree", interrupted)
    monkeypatch.undo()
    assert directory.exists()
    files.remove_leftovers(tmp_path)
    assert not directory.exists()


def test_only_files_that_were_written_are_removed(tmp_path: Path) -> None:
    directory, elsewhere = tmp_path / "views", tmp_path / "elsewhere"
    names = ("manifest.json", "crops/0.npz", "crops/mine.npz", "empty/deep/0.npz")
    for path in (elsewhere / "0.npz", *(directory / name for name in names)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    (directory / "link").symlink_to(elsewhere)
    killed(directory / "crops")
    files.remove_written(directory, r"manifest\.json", r"(.*/)?0\.npz")
    left = {path.relative_to(directory).as_posix() for path in directory.rglob("*")}
    assert left == {"crops", "crops/mine.npz", "link"} and (elsewhere / "0.npz").exists()
    for path in (directory / "crops" / "mine.npz", directory / "link"):
        path.unlink()
    files.remove_written(directory)
    files.remove_written(tmp_path / "missing")
    assert not directory.exists()
    directory.symlink_to(elsewhere)
    files.remove_written(directory, r"0\.npz")
    assert directory.is_symlink() and elsewhere.is_dir() and not list(elsewhere.iterdir())


@pytest.mark.parametrize(
    ("content", "is_own"),
    [('[{"a": 1, "b": 2}]', True), ("[]", True), ('{"a": 1}', False), ("[1]", False), ("x", False)],
)
def test_json_is_known_by_its_keys(content: str, is_own: bool, tmp_path: Path) -> None:
    (tmp_path / "file").write_text(content)
    assert files.has_json(tmp_path / "file", ("a", "b")) == is_own and not files.has_json(tmp_path, ("a", "b"))


def test_shared_and_nested_yaml_values_are_read_but_not_merged() -> None:
    assert files.parse_yaml(b"a: &row [1, 2]\nb: *row\n") == {"a": [1, 2], "b": [1, 2]}
    assert files.parse_yaml(b"[" * 50 + b"]" * 50) is not None
    assert files.parse_yaml(b"") is None
    with pytest.raises(ValueError, match="merge key"):
        files.parse_yaml(b"a: &b {x: 1}\nc: {<<: *b}")
    assert files.parse_yaml(b"{000010: 0o10, 12: 0x10, 08: -3}") == {10: "0o10", 12: 16, "08": -3}  # none is octal


@pytest.mark.parametrize(
    "content",
    [
        *(b"[" * 5000, b"[1", b"a: 0x" + b"f" * 5000, b"<<: {a: 1}", b"!!int ''"),
        *(b"{1: a, 01: b}", b"a: &b [*b]", b"? &b [x]\n: [*b, *c]", b"a: !!python/object/apply:os.getpid []"),
    ],
    ids=["deep", "open", "digits", "merge", "int", "repeated", "cycle", "alias", "call"],
)
def test_damaged_yaml_is_a_value_error(content: bytes) -> None:
    with pytest.raises(ValueError):
        files.parse_yaml(content)


def test_yaml_has_a_largest_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("thor2_jax.files.MAX_YAML_BYTES", 20)
    monkeypatch.setattr("thor2_jax.files.MAX_YAML_VALUES", 5)
    assert files.parse_yaml(b"[1,2,3,4]") == [1, 2, 3, 4]
    many = "more than 5 values"
    for content, message in ((b"[1]" + b" " * 18, "21 bytes"), (b"[{1},1,1]", many), (b"[&a [1,2],*a,*a]", many)):
        with pytest.raises(ValueError, match=message):
            files.parse_yaml(content)


def test_damaged_json_is_refused(tmp_path: Path) -> None:
    for content in ("[" * 10**6, "1" * 10**5, '{"fx": ' * 10**5, "[", "{} {}", '{"a": {"1": 1, "1": 2}}'):
        (tmp_path / "a.json").write_text(content)
        assert_refused(r"a\.json is damaged", files.read_table, tmp_path / "a.json")
