"""Atomic writes, digests, and the check of output directories."""

import errno
import hashlib
import stat
from pathlib import Path

import pytest

from thor2_jax.errors import InputError
from thor2_jax.files import (
    atomic_directory,
    atomic_write,
    check_output_directory,
    directory_digest,
    json_digest,
    write_text,
)


def test_text_is_utf_8_and_readable_by_all(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write_text(path, "π\n")
    assert path.read_bytes() == b"\xcf\x80\n"
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert list(tmp_path.iterdir()) == [path]


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_write(path) as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".txt"
        temporary.write_text("half")
        assert path.read_text() == "old"
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_an_interrupt_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_write(tmp_path / "a.txt") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_a_new_file_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    write_text(str(path), "new")
    assert path.read_text() == "new"


def test_a_missing_folder_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_text(tmp_path / "missing" / "a.txt", "")
    assert list(tmp_path.iterdir()) == []


def test_a_new_or_empty_directory_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    (tmp_path / "empty").mkdir()
    for directory in ("empty", "link", "new", "a/b/c"):
        check_output_directory(tmp_path / directory)
        check_output_directory(tmp_path / directory, "marker", ("partial",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "link"]


def test_a_used_directory_needs_a_marker(tmp_path: Path) -> None:
    for name in ("partial", ".lock", "marker"):
        (tmp_path / name).touch()
        with pytest.raises(InputError, match=f"out: {tmp_path} already contains"):
            check_output_directory(tmp_path)
        if name != "marker":
            check_output_directory(tmp_path, "marker", ("partial",))
    with pytest.raises(InputError, match=f"out: {tmp_path} already contains marker"):
        check_output_directory(tmp_path, "other", ("partial",))
    check_output_directory(tmp_path, "marker")


def test_files_and_broken_links_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "absent")
    for name in ("file", "file/below", "link"):
        with pytest.raises(InputError, match=f"out: {tmp_path / name} "):
            check_output_directory(tmp_path / name, "marker")


def test_unwritable_directories_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(dir: Path) -> None:
        raise OSError(errno.EROFS, "Read-only file system", str(dir))

    monkeypatch.setattr("tempfile.TemporaryFile", fail)
    for directory in (tmp_path, tmp_path / "new" / "deep"):
        with pytest.raises(InputError, match=f"out: {directory} .*Read-only"):
            check_output_directory(directory)


def test_a_directory_digest_depends_on_names_and_contents(tmp_path: Path) -> None:
    digests = {directory_digest(tmp_path)}
    for name, content in (("a", "x"), ("b/c", "x"), ("a", "y")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content)
        digests.add(directory_digest(tmp_path))
    assert len(digests | {directory_digest(tmp_path, "prefix")}) == 5
    assert directory_digest(tmp_path) in digests


def test_a_json_digest_ignores_the_order_of_keys() -> None:
    digest = json_digest({"a": 1, "b": [2, 3]})
    assert digest == json_digest({"b": (2, 3), "a": 1}) != json_digest({"a": 1, "b": [2]})


def test_digests_are_those_of_earlier_versions(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("x")
    assert directory_digest(tmp_path, "3 4") == hashlib.sha256(b"3 4" + b"a 1" + b"x").hexdigest()
    assert json_digest({"b": 1, "a": 2}) == hashlib.sha256(b'{"a": 2, "b": 1}').hexdigest()


def test_a_directory_appears_when_it_is_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "deeper" / "out"
    with pytest.raises(KeyError), atomic_directory(target) as unfinished:
        (unfinished / "half").write_text("x")
        raise KeyError
    assert list(tmp_path.iterdir()) == []
    for content in ("first", "second"):
        with atomic_directory(target) as unfinished:
            assert content == "first" or (target / "file").read_text() == "first"
            (unfinished / "file").write_text(content)
    assert (target / "file").read_text() == "second"
    with pytest.raises(KeyError), atomic_directory(target):
        raise KeyError
    assert [path.name for path in target.parent.iterdir()] == ["out"] and (target / "file").read_text() == "second"
