"""Paths, atomic writes, digests, checks of output directories, files of arrays, and values in JSON and YAML files."""

import contextlib
import errno
import functools
import hashlib
import json
import math
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import filelock
import numpy as np
from numpy.typing import NDArray

from colornet.files import (
    PREFIX,
    atomic_write,
    check_replaceable,
    errors_name,
    open_file,
    read_file,
    remove_leftovers,
    temporary_directory,
)
from thor2_jax.errors import InputError, reason_of, refusing_os_errors
from thor2_jax.printable import first_names

__all__ = [
    "LOCK",
    "as_path",
    "atomic_directory",
    "atomic_write",
    "check_output_directory",
    "check_output_file",
    "check_writable",
    "content_digest",
    "errors_name",
    "file_digest",
    "has_json",
    "json_digest",
    "locked",
    "new_directory",
    "open_file",
    "pack_arrays",
    "parse_json",
    "parse_yaml",
    "read_file",
    "read_npy",
    "read_table",
    "remove_leftovers",
    "remove_written",
    "temporary_directory",
    "unpack_arrays",
    "write_bytes",
    "write_text",
]


def as_path(path: object, name: str) -> Path:
    """Return the path of a file as a Path; a value of another type, or with a null character, raises InputError."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{name} is of type {type(path).__name__}; expected a path")
    if "\0" in str(path):
        raise InputError(f"{name} is {str(path)!r}; expected a path without null characters")
    return Path(path)


def check_output_directory(directory: str | Path, marker: str | None = None, resumable: Collection[str] = ()) -> None:
    """Raise unless a command may write to a directory, so that no other files are overwritten and no work is lost.

    The directory may be missing or empty. A command that can resume also accepts the output of an interrupted run: a
    directory with the file `marker`, or one that contains only `resumable` names and names that begin with a dot (locks
    and temporary files).

    Args:
        directory: output directory of the command.
        marker: relative path of a file that only this command writes.
        resumable: names that this command writes before the marker.

    Raises:
        InputError: the directory contains anything else, or cannot be written.
    """
    directory = Path(directory)
    with refusing_os_errors(f"out: {directory} is not a directory that can be written", "choose another one"):
        names = sorted(path.name for path in directory.iterdir()) if os.path.lexists(directory) else []
        if marker or resumable:
            names = [name for name in names if name not in resumable and not name.startswith(".")]
        if names and not (marker and (directory / marker).is_file()):
            raise InputError(
                f"out: {directory} already contains {first_names(names, 3)}; expected a new or empty directory"
                f"{' or an interrupted run of this command' if marker or resumable else ''}; choose another directory"
            )
        check_writable(directory)


def check_output_file(name: str, path: Path | None, is_own: Callable[[Path], bool]) -> None:
    """Raise unless a command may write a file at the end of its work; missing directories will be created.

    Args:
        name: name of the argument.
        path: the file; None for none.
        is_own: function that returns whether an existing file has the content of an output of the command, which may
            be replaced.

    Raises:
        InputError: the path is a directory, device, pipe or socket, is a file that the command has not written, or
            cannot be written.
    """
    if path is None:
        return
    with refusing_os_errors(f"{name}: {path} is not a file that can be written", "choose another one"):
        check_replaceable(path)
        check_writable(path.absolute().parent)
    if path.exists() and not is_own(path):
        raise InputError(f"{name} is {path}, a file that this command has not written; choose another name")


def has_json(path: Path, keys: Collection[str]) -> bool:
    """Return whether a file contains a JSON object with these keys, or a list of such objects."""
    try:
        content = json.loads(read_file(path))
    except (OSError, ValueError, RecursionError):
        return False
    rows = content if isinstance(content, list) else [content]
    return all(isinstance(row, dict) and row.keys() >= set(keys) for row in rows)


def check_writable(directory: Path) -> None:
    """Raise OSError unless a file can be written in a directory, or in the nearest of its parents that exists."""
    existing = next(path for path in (directory, *directory.absolute().parents) if path.is_symlink() or path.exists())
    with tempfile.TemporaryFile(dir=existing) as file:
        file.write(bytes(1000))  # fails on a full disk


@contextlib.contextmanager
def new_directory(directory: Path) -> Iterator[None]:
    """Create a directory and its parents; at the end, remove those of them that were missing and are empty."""
    missing = [path for path in (directory, *directory.parents) if not path.exists()]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for path in missing:
            with contextlib.suppress(OSError):  # it has files, or does not exist
                path.rmdir()


LOCK = ".lock"


@contextlib.contextmanager
def locked(directory: Path, busy: Exception | None = None, seconds: float = 0.0) -> Iterator[None]:
    """Hold an exclusive lock on a directory, which is created as a `new_directory` if it is missing.

    The operating system releases the lock when the process ends, even if it is killed. The lock file is kept, except in
    a new directory without other files if `seconds` is 0.

    Args:
        directory: the directory.
        busy: error that is raised if another process or thread holds the lock. Default: one of an output directory.
        seconds: time to wait for it.

    Raises:
        InputError: `busy` is None, and another process holds the lock.
        OSError: the directory cannot be written, or its file system does not support locks.
    """
    is_new = not (seconds or directory.exists())  # one that waits for the lock needs the directory
    advice = "wait until it ends, or choose another directory"
    with new_directory(directory):
        # A soft lock, filelock's fallback on file systems without locks, would outlive a killed process.
        try:
            held = filelock.FileLock(directory / LOCK, timeout=seconds, fallback_to_soft=False).acquire()
        except filelock.Timeout:
            raise busy or InputError(f"out: another process is writing to {directory}; {advice}") from None
        with held:
            try:
                yield
            finally:
                if is_new and list(directory.glob("*")) == [directory / LOCK]:  # the directory may have been removed
                    (directory / LOCK).unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_directory(path: str | Path) -> Iterator[Path]:
    """Yield a temporary directory that takes the place of `path` if the block ends without an error.

    If `path` is a directory with files, those with the names of new files are replaced one by one, and the others stay.
    After an error in the block, or if a directory or a device has the name of a new file, nothing has changed.

    Args:
        path: the directory; its parents are created.
    """
    path = Path(path).resolve()
    try:
        with new_directory(path.parent), temporary_directory(path.parent) as temporary:
            unfinished = temporary / path.name
            unfinished.mkdir(0o755)
            yield unfinished
            if not path.is_dir() or not any(path.iterdir()):
                unfinished.rename(path)
            else:
                files = sorted(unfinished.iterdir())
                for file in files:
                    check_replaceable(path / file.name)
                for file in files:
                    file.replace(path / file.name)
    except OSError as error:
        # A failed write to a full disk names no file, or one in the temporary directory.
        full, hidden = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG), str(path.parent / PREFIX)
        if str(error.filename or "").startswith(hidden) or error.errno in full:
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def remove_written(directory: Path, *patterns: str) -> None:
    """Remove the files in a directory whose relative paths match a regular expression, then the empty directories.

    All other files stay, including the targets of symbolic links. If there are no other files, the directory is removed
    in one step.
    """
    if not directory.is_dir():
        return
    for folder in [directory, *(path for path in directory.rglob("*") if path.is_dir())]:
        remove_leftovers(folder)
    paths = sorted(directory.rglob("*"))
    folders = [path for path in paths if path.is_dir() and not path.is_symlink()]
    files = [path for path in paths if path not in folders]
    written = [p for p in files if any(re.fullmatch(each, p.relative_to(directory).as_posix()) for each in patterns)]
    if len(written) == len(files) and not directory.is_symlink():
        with temporary_directory(directory.parent) as temporary:
            directory.rename(temporary / directory.name)
        return
    for path in written:
        path.unlink(missing_ok=True)
    for folder in reversed(folders):
        with contextlib.suppress(OSError):  # The directory has other files.
            folder.rmdir()


def content_digest(parts: Iterable[str | bytes]) -> str:
    """Return the SHA-256 of texts and bytes in their order, in hexadecimal."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() if isinstance(part, str) else part)
    return digest.hexdigest()


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's content; a file that has not changed since the last call is not read again."""
    status = path.stat()
    return _file_digest(path.absolute(), status.st_mtime_ns, status.st_size)


@functools.lru_cache(maxsize=64)
def _file_digest(path: Path, modified: int, size: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def json_digest(value: Any) -> str:
    """Return the SHA-256 of a JSON value, which does not depend on the order of its keys."""
    return content_digest([json.dumps(value, sort_keys=True)])


def pack_arrays(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str] | None = None) -> bytes:
    """Return the content of a safetensors file with arrays and texts by name.

    Equal arrays and texts give equal bytes if there is at most one text: the order of several is random.
    """
    import safetensors.numpy  # at the top, every command would import it

    contiguous = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    return safetensors.numpy.save(contiguous, None if metadata is None else dict(metadata))


def unpack_arrays(content: bytes) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the arrays and the texts of `pack_arrays`; raise ValueError if the content is damaged."""
    import safetensors.numpy

    try:
        arrays = safetensors.numpy.load(content)
    except safetensors.SafetensorError as error:
        raise ValueError(str(error)) from None
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    return arrays, dict(header.get("__metadata__", {}))


def read_npy(stream: BinaryIO, max_bytes: int) -> NDArray[Any]:
    """Read an array from an NPY file; its size is checked before memory is allocated, and nothing is unpickled.

    Raises:
        Exception: of any type, if the file is damaged, contains Python objects or more than `max_bytes` of values.
    """
    version = np.lib.format.read_magic(stream)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = read_header[version](stream)
    if math.prod(shape) * max(dtype.itemsize, 1) > max_bytes:  # also refuses values without bytes (type V0)
        raise ValueError(f"shape {shape} of {dtype}; expected at most {max_bytes} bytes")
    stream.seek(0)
    return np.lib.format.read_array(stream, allow_pickle=False)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write `content` to `path`, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: str | Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, atomically; bytes of a file name that are not UTF-8 are escaped."""
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


MAX_YAML_BYTES = 2**24
MAX_YAML_VALUES = 10**6
"""Largest number of values in a YAML file after its aliases are expanded; a few lines can expand to gigabytes."""


def parse_json(content: bytes) -> Any:
    """Return the value in a JSON file; raise ValueError if it is damaged, or a table in it has a key twice."""
    try:
        return json.loads(content, object_pairs_hook=_table)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _table(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return a table; raise ValueError for a repeated key, of whose values all but the last would be lost."""
    table = dict(pairs)
    if len(table) < len(pairs):
        raise ValueError(f"it has the key {Counter(key for key, _ in pairs).most_common(1)[0][0]!r} twice")
    return table


def parse_yaml(content: bytes) -> Any:
    """Return the value in a YAML file; raise ValueError as `parse_json`, for a merge key, or if it is too large."""
    import yaml

    def table(each: Any, node: Any) -> dict[Any, Any]:
        if any(key.tag.endswith(":merge") for key, _ in node.value):
            raise ValueError("it has a merge key (<<), which can repeat its entries without a limit")
        return _table(each.construct_pairs(node, deep=True))

    def integer(each: Any, node: Any) -> int:  # 010 is ten, as in YAML 1.2 and in the numbers of objects of BOP
        return int(node.value) if node.value.isdecimal() else int(each.construct_yaml_int(node))

    loader: Any = type("Loader", (yaml.SafeLoader,), {})
    loader.add_constructor("tag:yaml.org,2002:map", table)
    loader.add_constructor("tag:yaml.org,2002:int", integer)
    if len(content) > MAX_YAML_BYTES:
        raise ValueError(f"it has {len(content)} bytes; expected at most {MAX_YAML_BYTES}")
    try:
        value = yaml.load(content, loader)
        size = _expanded_size(value, {})
    except Exception as error:  # constructors raise exceptions of several kinds, all of them caused by the content
        raise ValueError(reason_of(error)) from None
    if size > MAX_YAML_VALUES:
        raise ValueError(f"its aliases expand to more than {MAX_YAML_VALUES} values")
    return value


def _expanded_size(value: Any, sizes: dict[int, float]) -> float:
    """Return the number of values in `value`, counting shared ones each time they occur."""
    if not isinstance(value, (dict, list, set, tuple)):
        if isinstance(value, int):
            str(value)  # raises ValueError for integers of thousands of digits, which messages could not show
        return 1
    if id(value) not in sizes:
        sizes[id(value)] = math.inf  # a value that contains itself is infinite
        parts = [*value, *value.values()] if isinstance(value, dict) else value
        sizes[id(value)] = 1 + sum(_expanded_size(part, sizes) for part in parts)
    return sizes[id(value)]


def read_table(path: Path, kinds: tuple[type, ...] = (dict,)) -> Any:
    """Read a file with one table: JSON if its name ends in .json, YAML otherwise.

    Args:
        path: the file.
        kinds: types of a table; with `list`, a list counts as one.

    Raises:
        InputError: the file is damaged or contains something else; the message names the file.
        OSError: the file cannot be opened.
    """
    content = read_file(path)
    try:
        table = parse_json(content) if path.suffix.lower() == ".json" else parse_yaml(content)
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error})") from None
    if not isinstance(table, kinds):
        expected = "a table or a list" if list in kinds else "a table"
        raise InputError(f"{path} holds a value of type {type(table).__name__}; expected {expected}")
    return table
