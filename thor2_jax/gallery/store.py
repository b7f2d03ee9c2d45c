"""Galleries on disk, with changes that are atomic even if several processes write.

    GALLERY/index.json                     format, generation, fingerprint of the embedding, hidden classes, and for
                                           each object its name, file, number of views, source and date
    GALLERY/previous.json                  index.json before the last change, which can thus be undone
    GALLERY/objects/<SHA-256>.safetensors  embeddings and compact clouds of one object, with its name, source and date,
                                           and the surface of its mesh

A writer holds the lock, writes the files of new objects and then replaces index.json, so the gallery on disk is always
in the state before or after a change. The next writer removes object files that index.json does not name; all other
files stay. If index.json is lost, `thor2 objects --reembed` writes it again from the object files.
"""

import contextlib
import dataclasses
import json
import os
import re
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from thor2_jax.errors import InputError, reason_of, refusing_os_errors
from thor2_jax.files import (
    atomic_write,
    check_writable,
    content_digest,
    locked,
    new_directory,
    pack_arrays,
    read_file,
    remove_leftovers,
    unpack_arrays,
    write_text,
)
from thor2_jax.gallery.compact_clouds import CompactClouds
from thor2_jax.gallery.gallery import Gallery, GalleryObject

__all__ = [
    "GALLERY_DIRECTORY",
    "LOCK_SECONDS",
    "GalleryBusyError",
    "GalleryError",
    "check_exists",
    "check_index",
    "check_open_to_changes",
    "gallery_stamp",
    "load_gallery",
    "previous_gallery",
    "update_gallery",
]

GALLERY_FORMAT, FORMAT_WITH_SURFACES = 1, 2
"""Versions of the layout above; the second one has surfaces, and earlier versions of this software cannot read it."""

GALLERY_DIRECTORY = "gallery"
"""Name of the gallery in a run directory."""

INDEX_FILE = "index.json"

SURFACE = "surface_"
"""Prefix of the names of a surface's arrays in the file of an object."""

_DIGEST = re.compile("[0-9a-f]{64}")

PREVIOUS_FILE = "previous.json"

LOCK_SECONDS = 20.0
"""Time that a writer waits for another writer; a change takes milliseconds."""


class GalleryError(InputError):
    """Error of a gallery on disk that is damaged or has another embedding. The message names the file."""


class GalleryBusyError(GalleryError):
    """Error of a gallery to which another process or thread is writing."""


def gallery_stamp(directory: Path) -> tuple[int, int, int] | None:
    """Return a value that differs after every change of the gallery in a directory; None if there is no gallery."""
    try:
        status = (directory / INDEX_FILE).stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def check_exists(directory: Path | None) -> None:
    """Raise GalleryError if a given directory has neither an index nor objects from which it can be rebuilt."""
    if directory is not None and gallery_stamp(directory) is None and not any(_own_objects(directory)):
        raise GalleryError(f"gallery: {directory} has no {INDEX_FILE}; expected the directory of a gallery")


def check_open_to_changes(directory: Path) -> None:
    """Raise InputError unless the gallery in a directory can be written, and no other writer holds the lock."""
    with refusing_os_errors(f"gallery: {directory} cannot be written", "choose another directory (--gallery)"):
        check_writable(directory)
        if gallery_stamp(directory) is not None:
            with _writing(directory, LOCK_SECONDS):
                pass


def _writing(directory: Path, seconds: float) -> contextlib.AbstractContextManager[None]:
    """Return the lock of a writer; it raises GalleryBusyError if another one holds it for some seconds."""
    busy = f"another process or thread has been writing to {directory} for {seconds:.2g} s; try again when it ends"
    return locked(directory, GalleryBusyError(f"gallery: {busy}"), seconds)


def check_index(directory: Path) -> None:
    """Raise GalleryError if the path, or `objects` in it, is not a directory, or if it has objects but no index."""
    for path in (directory, directory / "objects"):
        if path.exists() and not path.is_dir():
            raise GalleryError(f"gallery: {path} is not a directory; expected that of a gallery; choose another one")
    if gallery_stamp(directory) is None and any(_own_objects(directory)):
        raise _unusable(directory, f"{directory} has objects, but no {INDEX_FILE}", "rebuild it")


KEEP_OTHERS = f"delete {INDEX_FILE} and keep the other objects"


def _unusable(directory: Path, problem: str, repair: str = KEEP_OTHERS) -> GalleryError:
    """Return the error of a gallery whose index can be rebuilt from the object files that are intact."""
    command = f"thor2 objects --reembed --model RUN --gallery {shlex.quote(str(directory))}"
    return GalleryError(f"gallery: {problem}; restore it from a copy, or {repair}: {command}")


def load_gallery(
    directory: Path, fingerprint: str | None = None, earlier: Gallery | None = None, *, rebuild: bool = False
) -> Gallery:
    """Read a gallery; a gallery that does not exist is empty.

    Args:
        directory: directory of the gallery.
        fingerprint: fingerprint of the embedding that the gallery must have; None accepts any.
        earlier: an earlier state of the gallery, whose objects are not read again.
        rebuild: if the index is missing, return a gallery of all object files.

    Raises:
        GalleryError: a file is missing or damaged, the gallery has another embedding, or that of `earlier` was removed.
            The message names the file.
    """
    for _ in range(3):
        stamp = gallery_stamp(directory)  # of this index or of an earlier one
        index = _read_index(directory / INDEX_FILE)
        if index is None and rebuild:
            return _rebuilt(directory)
        if index is None:
            check_index(directory)
            if earlier is not None and (earlier.objects or earlier.hidden):
                raise GalleryError(f"gallery: {directory} was removed; restore it from a copy, or restart without it")
            return Gallery(fingerprint or "")
        if fingerprint is not None and index["embedding"] != fingerprint:
            raise GalleryError(
                f"gallery: {directory} was enrolled with the embedding {index['embedding'][:8]}, and the run has "
                f"{fingerprint[:8]}; embed its views again with `thor2 objects --reembed`"
            )
        # A file of the index is missing if a writer replaced it after the index was read, or if it was deleted.
        with contextlib.suppress(FileNotFoundError):
            return dataclasses.replace(_load_objects(directory, index, earlier), stamp=stamp)
    raise _unusable(directory, f"{directory} lacks files that {INDEX_FILE} names")


def _read_index(path: Path) -> dict[str, Any] | None:
    try:
        index = json.loads(read_file(path))
        fields = {"format": int, "generation": int, "embedding": str, "objects": list, "hidden": list}
        if not all(isinstance(index[field], kind) for field, kind in fields.items()):
            raise TypeError("a field has another type")
        json.dumps(index, ensure_ascii=False).encode()  # raises for text that could not be written again
        names, files = ([entry[field] for entry in index["objects"]] for field in ("name", "file"))
        # Names from older versions may fail `check_name`.
        if len(set(names)) < len(names) or not all(isinstance(name, str) and name.isprintable() for name in names):
            raise ValueError("a name is missing or listed twice")
        if not all(isinstance(file, str) and _DIGEST.fullmatch(file) for file in files):
            raise ValueError("an object has no file")
    except FileNotFoundError:
        return None
    except OSError as error:
        raise GalleryError(f"gallery: {path} cannot be read ({error.strerror}); check the permissions") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        problem = f"{path} is damaged ({reason_of(error)})"
        raise _unusable(path.parent, problem, "delete this file and rebuild it") from None
    if index["format"] not in (GALLERY_FORMAT, FORMAT_WITH_SURFACES):
        raise GalleryError(f"gallery: {path} has format {index['format']}; expected {FORMAT_WITH_SURFACES} or less")
    return dict(index)


def _load_objects(directory: Path, index: dict[str, Any], earlier: Gallery | None) -> Gallery:
    loaded = {} if earlier is None else {enrolled.file: enrolled for enrolled in earlier.objects.values()}
    objects: dict[str, GalleryObject] = {}
    for entry in index["objects"]:
        enrolled = loaded.get(entry["file"]) or _read_object(_object_file(directory, entry["file"]))[1]
        objects[entry["name"]] = _with_origin(enrolled, entry)
    sizes = {enrolled.embeddings.shape[1] for enrolled in objects.values()}
    if len(sizes) > 1:
        raise GalleryError(f"gallery: {directory} has embeddings of {sorted(sizes)} numbers; expected one size")
    return Gallery(index["embedding"], objects, tuple(map(str, index["hidden"])), generation=index["generation"])


def _object_file(directory: Path, digest: str) -> Path:
    return directory / "objects" / f"{digest}.safetensors"


def _origin(enrolled: GalleryObject) -> dict[str, str]:
    return {"source": enrolled.source, "date": enrolled.date}


def _with_origin(enrolled: GalleryObject, entry: Mapping[str, Any]) -> GalleryObject:
    return dataclasses.replace(enrolled, source=str(entry.get("source", "")), date=str(entry.get("date", "")))


def _object_content(name: str, enrolled: GalleryObject) -> bytes:
    arrays = {"embeddings": enrolled.embeddings, **vars(enrolled.clouds)}
    arrays |= {SURFACE + field: array for field, array in (enrolled.surface or {}).items()}
    return pack_arrays(arrays, {"object": json.dumps({"name": name, **_origin(enrolled)})})


def _read_object(path: Path) -> tuple[str | None, GalleryObject]:
    """Return the name of an object (None in files of earlier versions) and the object."""
    try:
        content = read_file(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise GalleryError(f"gallery: {path} cannot be read ({error.strerror}); check the permissions") from None
    if content_digest([content]) != path.stem:
        raise _unusable(path.parent.parent, f"{path} is damaged")
    try:
        arrays, metadata = unpack_arrays(content)
        about = json.loads(metadata.get("object", "{}"))
        of_surface = {name.removeprefix(SURFACE): arrays.pop(name) for name in list(arrays) if name.startswith(SURFACE)}
        enrolled = GalleryObject(
            arrays.pop("embeddings"), CompactClouds(**arrays), "", "", of_surface or None, path.stem
        )
        return about.get("name"), _with_origin(enrolled, about)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise GalleryError(f"gallery: {path} is not an object of a gallery ({error})") from None


def update_gallery(
    directory: Path,
    change: Callable[[Gallery], Gallery],
    fingerprint: str | None = None,
    earlier: Gallery | None = None,
    lock_seconds: float = LOCK_SECONDS,
) -> Gallery:
    """Change a gallery on disk without losing the change of another writer.

    Args:
        directory: directory of the gallery; created if it is missing.
        change: function of the gallery on disk that returns the new one. If it raises, nothing changes on disk.
        fingerprint: fingerprint of the embedding that the gallery must have. None accepts any, for a `change` that
            embeds the views again; if the index is missing, the change then starts from the existing object files.
        earlier: an earlier state of the gallery, whose objects are not read again; their missing files are written.
        lock_seconds: time to wait for another writer.

    Returns:
        The gallery after the change.

    Raises:
        GalleryError: the gallery cannot be read.
        GalleryBusyError: another process or thread holds the lock.
        OSError: a file cannot be written; the gallery is unchanged.
    """
    rebuild = fingerprint is None
    earlier = load_gallery(directory, fingerprint, earlier, rebuild=rebuild)  # raises before a directory is created
    with _writing(directory, lock_seconds), new_directory(directory / "objects"):
        before = load_gallery(directory, fingerprint, earlier, rebuild=rebuild)
        changed = dataclasses.replace(change(before), generation=before.generation + 1)
        _remove_orphans(directory, {enrolled.file for each in (before, changed) for enrolled in each.objects.values()})
        objects = dict(changed.objects)
        written: list[Path] = []
        try:
            if before.stamp is None and not before.objects:
                # The index is written first, so that a killed writer leaves an empty gallery, not objects without it.
                written.append(directory / INDEX_FILE)
                write_text(written[0], _index_content(Gallery(changed.embedding)))
            for name, enrolled in changed.objects.items():
                # Another program may have removed the file of an object that this process has in memory.
                if enrolled.file is None or not _object_file(directory, enrolled.file).exists():
                    content = _object_content(name, enrolled)
                    file = content_digest([content])
                    objects[name] = dataclasses.replace(enrolled, file=file)
                    path = _object_file(directory, file)
                    if not path.exists():
                        written.append(path)
                        _write_durably(path, content)
            changed = dataclasses.replace(changed, objects=objects)
            write_text(directory / INDEX_FILE, _index_content(changed))
        except BaseException:
            index = _read_index(directory / INDEX_FILE)
            if index is None or index["generation"] < changed.generation:  # Otherwise the index names the files.
                for path in reversed(written):
                    path.unlink(missing_ok=True)
            raise
        # The change is complete. If this write fails, or if previous.json is another file, it only cannot be undone.
        with contextlib.suppress(OSError, GalleryError):
            _read_index(directory / PREVIOUS_FILE)
            write_text(directory / PREVIOUS_FILE, _index_content(before))
        return dataclasses.replace(changed, stamp=gallery_stamp(directory))


def previous_gallery(directory: Path, generation: int, gallery: Gallery) -> Gallery:
    """Return the state of a gallery before its last change, for use with `update_gallery`.

    If this change is undone as well, the first change is restored.

    Args:
        directory: directory of the gallery.
        generation: generation of the gallery after the change that is undone.
        gallery: the gallery on disk.

    Raises:
        InputError: the gallery has been changed since, or the state before the change is not known.
    """
    index = None
    with contextlib.suppress(GalleryError):
        index = _read_index(directory / PREVIOUS_FILE)
    if gallery.generation != generation:
        raise InputError(f"generation is {generation}; expected {gallery.generation}: the gallery has changed since")
    if index is None or index["generation"] != generation - 1 or index["embedding"] != gallery.embedding:
        raise InputError(f"generation is {generation}, and the gallery before it is not known; forget the object")
    with contextlib.suppress(FileNotFoundError):
        return _load_objects(directory, index, gallery)
    raise InputError(f"generation is {generation}, and files of the gallery before it are missing")


def _write_durably(path: Path, content: bytes) -> None:
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())  # the files must reach the disk before the index that names them


def _index_content(gallery: Gallery) -> str:
    has_surface = any(enrolled.surface is not None for enrolled in gallery.objects.values())
    index = {
        "format": FORMAT_WITH_SURFACES if has_surface else GALLERY_FORMAT,
        "generation": gallery.generation,
        "embedding": gallery.embedding,
        "objects": [
            {"name": name, "file": enrolled.file, "views": len(enrolled.clouds), **_origin(enrolled)}
            for name, enrolled in gallery.objects.items()
        ],
        "hidden": list(gallery.hidden),
    }
    return json.dumps(index, indent=1, ensure_ascii=False) + "\n"


def _own_objects(
    directory: Path, used: Collection[str | None] = ()
) -> Iterator[tuple[Path, tuple[str | None, GalleryObject]]]:
    """Yield each valid object file that is not in `used`, with the result of `_read_object`."""
    for path in sorted((directory / "objects").glob("*.safetensors")):
        with contextlib.suppress(GalleryError, FileNotFoundError):
            if _DIGEST.fullmatch(path.stem) and path.stem not in used:
                yield path, _read_object(path)


def _remove_orphans(directory: Path, used: Collection[str | None]) -> None:
    """Remove the leftovers of an interrupted writer, and the files of objects that an earlier change removed."""
    remove_leftovers(directory / "objects")  # Writing the index removes the leftovers beside it.
    if (directory / "objects").is_symlink():  # Another gallery may use the linked files.
        return
    for path, _ in _own_objects(directory, used):
        if not path.is_symlink():
            path.unlink(missing_ok=True)


def _rebuilt(directory: Path) -> Gallery:
    """Return a gallery of all object files in a directory without an index; its embedding is unknown."""
    previous: dict[str, Any] = {"objects": [], "hidden": [], "generation": -1}
    with contextlib.suppress(GalleryError):
        previous = _read_index(directory / PREVIOUS_FILE) or previous
    listed = {entry["file"]: entry for entry in previous["objects"]}
    objects = []
    for path, (name, enrolled) in _own_objects(directory):
        entry = listed.get(path.stem)
        if name is None and entry is not None:
            name, enrolled = entry["name"], _with_origin(enrolled, entry)
        # If two files have the same name, the one that the previous index lacks is newer.
        objects.append((entry is None, enrolled.date, name or f"object-{path.stem[:8]}", enrolled))
    objects.sort(key=lambda each: each[:3])
    of_name = {name: enrolled for *_, name, enrolled in objects}
    return Gallery("", of_name, tuple(map(str, previous["hidden"])), generation=previous["generation"] + 1)
