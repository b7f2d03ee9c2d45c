"""Training clouds of a folder of meshes: rendered to memory, or to a folder of files that training reads later.

    views = render_views(find_meshes("meshes"), azimuth_step=5, polar_step=5, workers=2)     # name -> clouds
    render_to_folder(find_meshes("meshes"), "views", azimuth_step=5, polar_step=5, workers=2)
    views = read_view_folder("views")                                                        # the same

A folder holds `manifest.json` and one `.npz` an object. The manifest is written last: a folder without one is
incomplete.
"""

import json
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError
from thor2_jax.files import replacing, write_text
from thor2_jax.recognizer import VOXEL
from training.meshes import TexturedMesh, load_mesh
from training.view_sphere import view_angles
from training.views import MIN_POINTS, SIGMA_S, Cloud, iterate_views

__all__ = ["read_view_folder", "render_to_folder", "render_views"]

FORMAT = 1
MANIFEST = "manifest.json"

Progress = Callable[[int, int], object]
"""Called with (views done, views in all)."""


class _Loaded(Mapping[str, TexturedMesh]):
    """Meshes that are read from their files when they are asked for; holds the last one."""

    def __init__(self, found: Mapping[str, Path | TexturedMesh]) -> None:
        self._found = found
        self._last: tuple[str, TexturedMesh] | None = None

    def __getitem__(self, name: str) -> TexturedMesh:
        source = self._found[name]
        if isinstance(source, TexturedMesh):
            return source
        if self._last is None or self._last[0] != name:
            self._last = name, load_mesh(source)
        return self._last[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def _objects(
    found: Mapping[str, Path | TexturedMesh], azimuth_step: float, polar_step: float, workers: int, progress: Progress
) -> Iterator[tuple[str, list[Cloud], int]]:
    """Each object's name, its clouds of at least `MIN_POINTS` points, and how many views have fewer."""
    if not found:
        raise InputError("found is empty; at least one mesh is needed")
    angles = view_angles(azimuth_step, polar_step)
    meshes = _Loaded(found)
    # A mesh that cannot be read is told of now, not after an hour of rendering those before it.
    for name in meshes:
        meshes[name]
    done, total = 0, len(angles) * len(found)
    views = iterate_views(meshes, angles, workers)
    for name in found:
        clouds: list[Cloud] = []
        for _ in range(len(angles)):
            view = next(views)
            if not view.sparse:
                clouds.append((view.xyz, view.rgb))
            done += 1
            progress(done, total)
        if not clouds:
            raise InputError(f"object {name!r}: none of its {len(angles)} views has {MIN_POINTS} points or more")
        yield name, clouds, len(angles) - len(clouds)


def render_views(
    found: Mapping[str, Path | TexturedMesh],
    azimuth_step: float = 5.0,
    polar_step: float = 5.0,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> dict[str, list[Cloud]]:
    """Training clouds of every object, in memory (a view of a scan takes about 15 kB).

    Args:
        found: object name -> mesh file, as from `find_meshes`, or mesh.
        azimuth_step: degrees; divides 360.
        polar_step: degrees; divides 180.
        workers: processes that render; the result does not depend on their number.
        progress: called after each view.

    Returns:
        name -> clouds (xyz [n, 3] float32 metres in the camera frame, rgb [n, 3] uint8), in the order of `found` and of
        `view_angles`; views of fewer than `MIN_POINTS` points are left out.

    Raises:
        InputError: no meshes, a mesh that cannot be read or is never seen, or steps or workers that do not fit.
    """
    return {name: clouds for name, clouds, _ in _objects(found, azimuth_step, polar_step, workers, progress)}


def render_to_folder(
    found: Mapping[str, Path | TexturedMesh],
    out: str | Path,
    azimuth_step: float = 5.0,
    polar_step: float = 5.0,
    workers: int = 1,
    progress: Progress = lambda done, total: None,
) -> dict[str, tuple[int, int]]:
    """Write the training clouds of every object to a folder for `read_view_folder`; one object at a time is in memory.

    Args:
        found: as of `render_views`, and so are the steps, `workers` and `progress`.
        out: new or empty folder; made with its parents.
        azimuth_step: degrees.
        polar_step: degrees.
        workers: processes.
        progress: called after each view.

    Returns:
        name -> (number of views written, number left out because they have fewer than `MIN_POINTS` points).

    Raises:
        InputError: `out` holds something already, or what `render_views` raises.
        OSError: `out` cannot be written.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"out: {out} exists already and is not an empty folder")
    objects: dict[str, dict[str, Any]] = {}
    for name, clouds, left_out in _objects(found, azimuth_step, polar_step, workers, progress):
        out.mkdir(parents=True, exist_ok=True)
        # Numbered: an object's name need not be a good file name.
        file = f"views-{len(objects):03d}.npz"
        counts = np.array([len(xyz) for xyz, _ in clouds], np.int64)
        with replacing(out / file) as temporary:
            np.savez(
                temporary,
                counts=counts,
                xyz=np.concatenate([xyz for xyz, _ in clouds]),
                rgb=np.concatenate([rgb for _, rgb in clouds]),
            )
        objects[name] = {"file": file, "views": len(clouds), "left_out": left_out, "points": int(counts.sum())}
    manifest = {
        "format": FORMAT,
        "azimuth_step": azimuth_step,
        "polar_step": polar_step,
        "sigma_s": SIGMA_S,
        "voxel": VOXEL,
        "objects": objects,
    }
    write_text(out / MANIFEST, json.dumps(manifest, indent=1) + "\n")
    return {name: (entry["views"], entry["left_out"]) for name, entry in objects.items()}


def _read_object(path: Path, views: int, points: int) -> list[Cloud]:
    try:
        # Opened here: numpy leaves a file that it cannot read open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            counts, xyz, rgb = (file[key] for key in ("counts", "xyz", "rgb"))
    # numpy and zipfile raise any of these on damaged bytes.
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"dataset: {path} is missing or damaged ({' '.join(str(error).split())})") from None
    expected: list[tuple[NDArray[Any], Any, tuple[int, ...]]] = [
        (counts, np.int64, (views,)),
        (xyz, np.float32, (points, 3)),
        (rgb, np.uint8, (points, 3)),
    ]
    if any(array.dtype != dtype or array.shape != shape for array, dtype, shape in expected) or (
        counts.sum() != points or (counts < MIN_POINTS).any() or not np.isfinite(xyz).all()
    ):
        raise InputError(
            f"dataset: {path} does not hold the {views} views with {points} points that the manifest tells of"
        )
    ends = np.cumsum(counts)[:-1]
    return list(zip(np.split(xyz, ends), np.split(rgb, ends), strict=True))


def read_view_folder(path: str | Path) -> dict[str, list[Cloud]]:
    """Read a folder that `render_to_folder` wrote.

    Returns:
        What `render_views` returns.

    Raises:
        InputError: no such folder, no manifest in it (rendering did not finish), another format or scale, or a file of
            it missing or damaged; names the file.
    """
    folder = Path(path)
    manifest = folder / MANIFEST
    if not folder.is_dir():
        raise InputError(f"dataset: {folder} is no folder")
    if not manifest.is_file():
        raise InputError(f"dataset: {folder} has no {MANIFEST}; it is no folder of views, or rendering did not finish")
    try:
        table = json.loads(manifest.read_bytes())
        version, scale = table["format"], (table["sigma_s"], table["voxel"])
        entries = {
            str(name): (str(entry["file"]), int(entry["views"]), int(entry["points"]))
            for name, entry in table["objects"].items()
        }
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError(f"dataset: {manifest} is damaged ({type(error).__name__}: {error})") from None
    if version != FORMAT:
        raise InputError(f"dataset: {manifest} has format {version!r}; this version reads {FORMAT}")
    if scale != (SIGMA_S, VOXEL):
        raise InputError(f"dataset: {manifest} has sigma_s and voxel {scale}; expected {(SIGMA_S, VOXEL)}")
    if not entries:
        raise InputError(f"dataset: {manifest} lists no objects")
    return {name: _read_object(folder / file, views, points) for name, (file, views, points) in entries.items()}
