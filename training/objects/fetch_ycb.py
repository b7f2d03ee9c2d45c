"""Download scanned meshes of the YCB objects. No other part of this software downloads anything.

The archives are the `google_16k` archives of the YCB Object and Model Set, with 16,000 faces per mesh. The files of an
object are written to `<directory>/<object>`, where `find_meshes` finds `textured.obj`.
"""

import gzip
import re
import shutil
import sys
import tarfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import httpx

from thor2_jax.errors import InputError, reason_of
from thor2_jax.files import atomic_directory, check_output_directory, errors_name, locked
from training.objects.meshes import load_mesh
from training.storage.jobs import Progress

__all__ = ["LICENCE", "YCB_URL", "fetch_ycb"]

YCB_URL = "http://ycb-benchmarks.s3-website-us-east-1.amazonaws.com/data/google"

LICENCE = (
    "The scans are those of the YCB Object and Model Set (Calli et al., IEEE Robotics and Automation Magazine 22(3), "
    "2015), licence CC BY 4.0, https://creativecommons.org/licenses/by/4.0/: whoever shares them, or pictures of them, "
    "must name this source."
)

NAME = re.compile(r"\d{3}(-[a-z])?_[a-z0-9_-]+")
MESH_FILE = "textured.obj"
TIMEOUT = 30.0
"""Seconds without any received data after which the server is considered unreachable."""

CHUNK_BYTES = 2**18
MAX_BYTES = 2**29
"""Largest size of an archive and of its content; the archives of the set have about 10 MB."""


def fetch_ycb(
    objects: Sequence[str], directory: str | Path, *, url: str = YCB_URL, progress: Progress = lambda *_: None
) -> dict[str, Path]:
    """Download the meshes of YCB objects: object name -> mesh file, in the order of `objects`.

    Objects whose mesh is already in the directory are not downloaded again. An interrupted download resumes. A damaged
    archive is removed.

    Args:
        objects: names as in the set, such as "003_cracker_box".
        directory: directory of the meshes, `<directory>/<object>/textured.obj`; may contain other objects.
        url: address of the folder with the archives `<object>_google_16k.tgz`.
        progress: called with (object, downloaded kB, total kB, "").

    Raises:
        InputError: a name or the address is invalid, the server has no such object or cannot be reached, an archive or
            mesh is damaged, or another process writes to the directory.
        OSError: the directory cannot be written.
    """
    wrong = [name for name in objects if not NAME.fullmatch(name)]
    if wrong or not objects:
        given = f"has {wrong[0]!r}" if wrong else "is empty"
        raise InputError(f"objects {given}; expected names of YCB objects, such as 003_cracker_box")
    directory = Path(directory)
    if not directory.is_dir():
        check_output_directory(directory)
    meshes = {}
    with locked(directory):
        for name in objects:
            meshes[name] = directory / name / MESH_FILE
            if meshes[name].is_file():
                load_mesh(meshes[name])
                continue
            if (directory / name).exists():
                raise InputError(f"out: {directory / name} exists without {MESH_FILE}; move it, or choose another one")
            archive = directory / f".{name}.tgz"
            _download(f"{url.rstrip('/')}/{name}_google_16k.tgz", archive, name, progress)
            _extract(archive, directory, name)
    return meshes


def _download(address: str, archive: Path, name: str, progress: Progress) -> None:
    """Download an archive; continue after the bytes that `archive` already contains."""
    have = archive.stat().st_size if archive.exists() else 0
    if have:
        with archive.open("rb") as stream:
            if stream.read(2) != b"\x1f\x8b":
                raise InputError(f"out: {archive} is not a download of this command (gzip); move it")
    headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={have}-"} if have else {})
    try:
        with httpx.stream("GET", address, headers=headers, timeout=TIMEOUT, follow_redirects=True) as answer:
            if answer.status_code == 416:  # the archive is complete; `_extract` removes a damaged one
                return
            if answer.status_code in (403, 404):
                raise InputError(f"objects has {name!r}, but there is no {address}; see the names at ycbbenchmarks.com")
            answer.raise_for_status()
            if answer.status_code != 206:  # the server sends the whole archive
                have = 0
            total = have + int(answer.headers.get("Content-Length", 0))
            with errors_name(archive), archive.open("ab" if have else "wb") as stream:
                for block in answer.iter_raw():
                    have += len(block)
                    if max(have, total) > MAX_BYTES:
                        archive.unlink()
                        size = f"more than {MAX_BYTES:,} bytes"
                        raise InputError(f"url: {archive.name[1:]} has {size}; expected an archive of the YCB set")
                    stream.write(block)
                    progress(name, have // 1000, max(have, total) // 1000, "kB")
    except InputError:
        raise
    # ImportError is raised for proxies of other kinds, ValueError by name resolution.
    except (httpx.HTTPError, httpx.InvalidURL, ImportError, ValueError) as error:
        raise InputError(
            f"url: {address} cannot be read ({reason_of(error)}); expected an address such as {YCB_URL}; check the "
            "network, then repeat the command, it resumes"
        ) from None


def _extract(archive: Path, directory: Path, name: str) -> None:
    """Move the files of the archive to `directory / name`; remove it, except after an interrupt or on a full disk.

    Only regular files in `google_16k` are moved, without their folders. The archive is read to its end, so that the
    checksum of gzip is verified.
    """
    total = 0
    try:
        with atomic_directory(directory / name) as folder:
            with gzip.open(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as content:
                for member in content:
                    path = PurePosixPath(member.name)
                    total += member.size
                    if total > MAX_BYTES:
                        raise InputError(f"more than {MAX_BYTES:,} bytes")
                    is_of_mesh = path.parent.name == "google_16k" and not path.name.startswith(".")
                    if is_of_mesh and member.isfile() and (source := content.extractfile(member)):
                        with source, (folder / path.name).open("xb") as target:
                            shutil.copyfileobj(source, target)
                while stream.read(CHUNK_BYTES):
                    pass
            load_mesh(folder / MESH_FILE)
    except (tarfile.TarError, gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise InputError(f"objects: the archive of {name} is damaged ({error}); repeat the command") from None
    except (InputError, FileExistsError) as error:
        reason = reason_of(error).replace(f"{folder.parent}/", "")
        raise InputError(f"objects: archive of {name} has no usable mesh ({reason}); report this to its host") from None
    finally:
        if not isinstance(sys.exc_info()[1], (KeyboardInterrupt, OSError)):
            archive.unlink()
