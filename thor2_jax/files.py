"""Atomic writes, digests, and the check of output directories."""

import contextlib
import functools
import hashlib
import json
import shutil
import tempfile
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any

from colornet.files import atomic_write, errors_name, remove_leftovers
from thor2_jax.errors import InputError

__all__ = [
    "atomic_directory",
    "atomic_write",
    "check_output_directory",
    "content_digest",
    "directory_digest",
    "errors_name",
    "file_digest",
    "json_digest",
    "remove_leftovers",
    "write_text",
]


def check_output_directory(directory: str | Path, marker: str | None = None, resumable: Collection[str] = ()) -> None:
    """Raise unless a command may write to a directory, so that nothing foreign is overwritten and no work is lost.

    The directory may be missing or empty. A command that resumes also accepts what an interrupted run of it leaves: any
    directory with the file `marker`, and one that holds nothing but `resumable` names and names that begin with a dot
    (locks and temporary files).

    Args:
        directory: output directory of the command.
        marker: relative path of a file that only this command writes.
        resumable: names that this command writes before the marker.

    Raises:
        InputError: if the directory holds anything else, or cannot be written.
    """
    directory = Path(directory)
    try:
        names = (
            sorted(path.name for path in directory.iterdir()) if directory.exists() or directory.is_symlink() else []
        )
        if marker or resumable:
            names = [name for name in names if name not in resumable and not name.startswith(".")]
        if names and not (marker and (directory / marker).is_file()):
            raise InputError(
                f"out: {directory} already contains {', '.join(names[:3])}; expected a new or empty directory"
                f"{' or an interrupted run of this command' if marker or resumable else ''}; choose another directory"
            )
        existing = next(path for path in (directory, *directory.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise InputError(
            f"out: {directory} is not a directory that can be written ({error.strerror}); choose another directory"
        ) from None


@contextlib.contextmanager
def atomic_directory(path: str | Path) -> Iterator[Path]:
    """Yield a temporary directory that takes the place of `path` if the block ends without an error.

    A directory that stands there is replaced. After an error, it stays as it was, and nothing else is left behind.

    Args:
        path: the directory; its parents are created.
    """
    path = Path(path).resolve()
    created = [parent for parent in path.parents if not parent.exists()]
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        unfinished = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        try:
            unfinished.chmod(0o755)
            yield unfinished
            if path.is_dir():
                shutil.rmtree(path)
            unfinished.rename(path)
        except BaseException:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
    except BaseException:
        for parent in created:
            with contextlib.suppress(OSError):
                parent.rmdir()
        raise


def content_digest(parts: Iterable[str | bytes]) -> str:
    """Return the SHA-256 of texts and bytes in their order, in hexadecimal."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() if isinstance(part, str) else part)
    return digest.hexdigest()


def directory_digest(directory: Path, prefix: str = "") -> str:
    """Return the SHA-256 of `prefix` and of the names, sizes and contents of all files in a directory."""

    def parts() -> Iterator[str | bytes]:
        yield prefix
        for path in sorted(path for path in directory.rglob("*") if path.is_file()):
            content = path.read_bytes()
            yield f"{path.relative_to(directory).as_posix()} {len(content)}"
            yield content

    return content_digest(parts())


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's content; a file that did not change since the last call is not read again."""
    status = path.stat()
    return _file_digest(path.absolute(), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=64)
def _file_digest(path: Path, modified: int, size: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def json_digest(value: Any) -> str:
    """Return the SHA-256 of a JSON value, whatever the order of its keys."""
    return content_digest([json.dumps(value, sort_keys=True)])


def write_text(path: str | Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
