"""Galleries on disk: changes are atomic, also when several processes write.

GALLERY/index.json                      format, generation, fingerprint of the embedding, hidden classes, and for each
                                        object its name, file, number of views, source and date
GALLERY/previous.json                   index.json before the last change, so that it can be taken back
GALLERY/objects/<SHA-256>.safetensors   embeddings and compact clouds of one object

A writer holds the lock, writes the files of new objects and then replaces index.json: the gallery on disk is always the
one before or the one after a change. Files that index.json does not name are removed by the next writer.
"""

import contextlib
import dataclasses
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import atomic_write, content_digest, write_text
from thor2_jax.gallery.clouds import CompactClouds
from thor2_jax.gallery.gallery import Gallery, GalleryObject, check_name

__all__ = [
    "GALLERY_DIRECTORY",
    "INDEX_FILE",
    "LOCK_SECONDS",
    "GalleryBusyError",
    "GalleryError",
    "StoredGallery",
    "gallery_stamp",
    "load_gallery",
    "undo_change",
    "update_gallery",
]

GALLERY_FORMAT = 1
"""Version of the layout above."""

GALLERY_DIRECTORY = "gallery"
"""Name of the gallery in a run directory."""

INDEX_FILE = "index.json"

PREVIOUS_FILE = "previous.json"

LOCK_SECONDS = 20.0
"""Time that a writer waits for another one; a change takes milliseconds."""


class GalleryError(InputError):
    """A gallery on disk cannot be used: it is damaged or has another embedding. The message names its file."""


class GalleryBusyError(GalleryError):
    """Another process is writing to the gallery."""


@dataclasses.dataclass(frozen=True, eq=False)
class StoredGallery:
    """A gallery as it was read.

    Attributes:
        gallery: the content.
        files: object -> name of its file.
        generation: number of changes so far.
        stamp: `gallery_stamp` of this state; None if the gallery is not on disk.
    """

    gallery: Gallery
    files: dict[str, str]
    generation: int
    stamp: tuple[int, int, int] | None = None


def gallery_stamp(directory: Path) -> tuple[int, int, int] | None:
    """Return a value that differs after every change of the gallery in a directory; None if there is no gallery."""
    try:
        status = (directory / INDEX_FILE).stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def load_gallery(directory: Path, embedding: str | None = None, known: StoredGallery | None = None) -> StoredGallery:
    """Read a gallery; one that does not exist is empty.

    Args:
        directory: directory of the gallery.
        embedding: fingerprint that the gallery must have; None accepts any.
        known: an earlier state, whose objects are not read again.

    Raises:
        GalleryError: a file is missing or damaged, or the gallery has another embedding. The message names the file.
    """
    for _ in range(3):
        stamp = gallery_stamp(directory)  # of this index or of an earlier one
        index = _read_index(directory / INDEX_FILE)
        if index is None:
            return StoredGallery(Gallery(embedding or ""), {}, 0)
        if embedding is not None and index["embedding"] != embedding:
            raise GalleryError(
                f"gallery: {directory} was enrolled with the embedding {index['embedding'][:8]}, and the run has "
                f"{embedding[:8]}; embed its views again with `thor2 objects --reembed`"
            )
        with contextlib.suppress(_Replaced):
            return dataclasses.replace(_load_objects(directory, index, known), stamp=stamp)
    raise GalleryError(
        f"gallery: {directory / INDEX_FILE} names files that do not exist; restore the directory from a copy"
    )


class _Replaced(Exception):
    """A file that the index names is missing: a writer replaced it after the index was read, or it was deleted."""


def _read_index(path: Path) -> dict[str, Any] | None:
    try:
        index = json.loads(path.read_bytes())
        fields = {"format": int, "generation": int, "embedding": str, "objects": list, "hidden": list}
        if not all(isinstance(index[field], kind) for field, kind in fields.items()):
            raise TypeError("a field has another type")
        names = [check_name(entry["name"]) for entry in index["objects"]] + [str(name) for name in index["hidden"]]
        files = [entry["file"] for entry in index["objects"]]
        if len(set(names[: len(files)])) < len(files) or not all(
            isinstance(file, str) and len(file) == 64 and file.isalnum() for file in files
        ):
            raise ValueError("an object is listed twice, or has no file")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise GalleryError(f"gallery: {path} cannot be read ({error.strerror}); check the permissions") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise GalleryError(
            f"gallery: {path} is damaged ({reason}); restore it from a copy, or delete the gallery"
        ) from None
    if index["format"] != GALLERY_FORMAT:
        raise GalleryError(f"gallery: {path} has format {index['format']}; expected {GALLERY_FORMAT}")
    return dict(index)


def _load_objects(directory: Path, index: dict[str, Any], known: StoredGallery | None) -> StoredGallery:
    loaded = {} if known is None else {file: known.gallery.objects[name] for name, file in known.files.items()}
    objects: dict[str, GalleryObject] = {}
    for entry in index["objects"]:
        views = loaded.get(entry["file"]) or _read_object(_object_file(directory, entry["file"]))
        objects[entry["name"]] = dataclasses.replace(views, source=str(entry["source"]), date=str(entry["date"]))
    sizes = {views.embeddings.shape[1] for views in objects.values()}
    if len(sizes) > 1:
        raise GalleryError(f"gallery: {directory} has embeddings of {sorted(sizes)} numbers; expected one size")
    gallery = Gallery(index["embedding"], objects, tuple(map(str, index["hidden"])))
    return StoredGallery(gallery, {entry["name"]: entry["file"] for entry in index["objects"]}, index["generation"])


def _object_file(directory: Path, digest: str) -> Path:
    return directory / "objects" / f"{digest}.safetensors"


def _object_content(views: GalleryObject) -> bytes:
    arrays: dict[str, NDArray[Any]] = {"embeddings": np.ascontiguousarray(views.embeddings, np.float16)}
    for field in dataclasses.fields(CompactClouds):
        arrays[field.name] = np.ascontiguousarray(getattr(views.clouds, field.name))
    return safetensors.numpy.save(arrays)


def _read_object(path: Path) -> GalleryObject:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise _Replaced from None
    except OSError as error:
        raise GalleryError(f"gallery: {path} cannot be read ({error.strerror}); check the permissions") from None
    if content_digest([content]) != path.stem:
        raise GalleryError(f"gallery: {path} is damaged; restore it from a copy, or delete the gallery")
    try:
        arrays = safetensors.numpy.load(content)
        embeddings = arrays.pop("embeddings")
        return GalleryObject(embeddings, CompactClouds(**arrays), "", "")
    except (safetensors.SafetensorError, KeyError, TypeError, ValueError) as error:
        raise GalleryError(f"gallery: {path} is no object of a gallery ({error})") from None


@contextlib.contextmanager
def _locked(directory: Path, seconds: float) -> Iterator[None]:
    directory.mkdir(parents=True, exist_ok=True)
    # A soft lock would outlive a killed process.
    lock = filelock.FileLock(directory / ".lock", timeout=seconds, fallback_to_soft=False)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise GalleryBusyError(
            f"gallery: another process has been writing to {directory} for {seconds:.2g} s; try again when it ends"
        ) from None
    try:
        yield
    finally:
        lock.release()


def update_gallery(
    directory: Path,
    change: Callable[[Gallery], Gallery],
    embedding: str | None = None,
    known: StoredGallery | None = None,
    lock_seconds: float | None = None,
) -> StoredGallery:
    """Change a gallery on disk; another writer's change is never lost.

    Args:
        directory: directory of the gallery; created if it is missing.
        change: function of the gallery on disk that returns the new one. Whatever it raises leaves the disk as it was.
        embedding: fingerprint that the gallery must have; None accepts any.
        known: an earlier state, whose objects are not read again.
        lock_seconds: time to wait for another writer; by default `LOCK_SECONDS`.

    Returns:
        The gallery after the change.

    Raises:
        GalleryError: the gallery cannot be read.
        GalleryBusyError: another process holds the lock.
        OSError: a file cannot be written; the gallery is as before.
    """
    with _locked(directory, LOCK_SECONDS if lock_seconds is None else lock_seconds):
        stored = load_gallery(directory, embedding, known)
        gallery = change(stored.gallery)
        (directory / "objects").mkdir(exist_ok=True)
        _remove_orphans(directory, set(stored.files.values()))
        files: dict[str, str] = {}
        written: list[Path] = []
        try:
            for name, views in gallery.objects.items():
                if name in stored.files and _same_arrays(views, stored.gallery.objects[name]):
                    files[name] = stored.files[name]
                    continue
                content = _object_content(views)
                files[name] = content_digest([content])
                path = _object_file(directory, files[name])
                if not path.exists():
                    written.append(path)
                    _write_durably(path, content)
            changed = StoredGallery(gallery, files, stored.generation + 1)
            write_text(directory / INDEX_FILE, _index_content(changed))
        except BaseException:
            for path in written:
                path.unlink(missing_ok=True)
            raise
        with contextlib.suppress(OSError):  # The change is made; it only cannot be taken back.
            write_text(directory / PREVIOUS_FILE, _index_content(stored))
        return dataclasses.replace(changed, stamp=gallery_stamp(directory))


def undo_change(
    directory: Path,
    generation: int,
    embedding: str | None = None,
    known: StoredGallery | None = None,
    lock_seconds: float | None = None,
) -> StoredGallery:
    """Take back the last change of a gallery on disk. That is a change, too: taking it back restores the first one.

    Args:
        directory: directory of the gallery.
        generation: generation of the gallery after the change that is taken back.
        embedding: see `update_gallery`.
        known: see `update_gallery`.
        lock_seconds: see `update_gallery`.

    Returns:
        The gallery as it was before that change, with a new generation.

    Raises:
        InputError: the gallery has been changed since, or the state before the change is not known.
        GalleryError: see `update_gallery`.
        OSError: see `update_gallery`.
    """

    def previous(gallery: Gallery) -> Gallery:
        current, index = _read_index(directory / INDEX_FILE), None
        with contextlib.suppress(GalleryError):
            index = _read_index(directory / PREVIOUS_FILE)
        last = 0 if current is None else current["generation"]
        if last != generation:
            raise InputError(f"generation is {generation}; expected {last}: the gallery has been changed since")
        if index is None or index["generation"] != generation - 1 or index["embedding"] != gallery.embedding:
            raise InputError(f"generation is {generation}, and the gallery before it is not known; forget the object")
        with contextlib.suppress(_Replaced):
            return _load_objects(directory, index, known).gallery
        raise InputError(f"generation is {generation}, and files of the gallery before it are missing")

    return update_gallery(directory, previous, embedding, known, lock_seconds)


def _same_arrays(views: GalleryObject, other: GalleryObject) -> bool:
    return views.embeddings is other.embeddings and views.clouds is other.clouds


def _write_durably(path: Path, content: bytes) -> None:
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # the index must not reach the disk before the files that it names


def _index_content(stored: StoredGallery) -> str:
    gallery = stored.gallery
    index = {
        "format": GALLERY_FORMAT,
        "generation": stored.generation,
        "embedding": gallery.embedding,
        "objects": [
            {
                "name": name,
                "file": stored.files[name],
                "views": len(views.clouds),
                "source": views.source,
                "date": views.date,
            }
            for name, views in gallery.objects.items()
        ],
        "hidden": list(gallery.hidden),
    }
    return json.dumps(index, indent=1, ensure_ascii=False) + "\n"


def _remove_orphans(directory: Path, used: set[str]) -> None:
    """Remove what an interrupted writer left, and the files of objects that an earlier change removed."""
    for path in (directory / "objects").iterdir():
        if path.name.removesuffix(".safetensors") not in used:
            path.unlink(missing_ok=True)
    for name in (INDEX_FILE, PREVIOUS_FILE):
        for path in directory.glob(f".{Path(name).stem}.*"):
            path.unlink(missing_ok=True)
