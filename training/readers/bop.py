"""Datasets in the scene-wise format of BOP, the Benchmark for 6D Object Pose Estimation: YCB-Video and others.

`<scene>/{rgb,depth}/<image>.png`, `<scene>/mask_visib/<image>_<instance>.png`, `scene_camera.json`, `scene_gt.json`
and, optionally, `scene_gt_info.json`; see docs/bop_datasets_format.md of github.com/thodan/bop_toolkit. The format
identifies objects by numbers; a YAML or JSON file maps each obj_id to a name.
"""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thor2_jax.errors import InputError, with_context
from thor2_jax.files import as_path, read_table
from thor2_jax.frames.frames import Intrinsics, RGBDFrame, read_color, read_depth, read_labels
from training.readers.labelled import LabelledFrames, named_labels, named_path

__all__ = ["BOP", "SMALLEST_VISIBLE", "read_object_names"]

MASKS = "mask_visib"
"""Folder of the masks of a scene."""

SMALLEST_VISIBLE = 0.1
"""Smallest visible fraction of an instance that is scored, as in BOP's own evaluation."""


class BOP(LabelledFrames):
    """The frames of a split (`test`), or of a single scene.

    Label k + 1 is instance k of `scene_gt.json`. Masks may overlap, since BOP computes them with a tolerance in depth
    and counts pixels without depth as visible. A pixel of several masks is assigned to the smallest mask. Instances are
    not scored if their mask is empty or if their visible fraction in `scene_gt_info.json` is below `SMALLEST_VISIBLE`.
    They keep their pixels, since they occlude other instances.
    """

    def __init__(self, path: str | Path, names: str | Path | None = None) -> None:
        """Find the frames.

        Args:
            path: folder of scenes, or of one scene.
            names: YAML or JSON file, obj_id -> name. Default: obj_000001 and so on.

        Raises:
            InputError: there are no frames, a scene has none, or `names` is damaged.
            OSError: `names` cannot be opened.
        """
        path = self.dataset_folder(named_path(path))
        folders = [file.parent for file in [*path.glob("scene_camera.json"), *path.glob("*/scene_camera.json")]]
        # A link such as "latest" adds no scene.
        scenes = sorted({each.resolve(): each for each in sorted(folders, reverse=True)}.values())
        self.sources = [image for scene in scenes for image in _images(scene / "rgb")]
        self.identifiers = [f"{_scene(image).name}/{image.stem}" for image in self.sources]
        if lacking := [scene for scene in scenes or [path] if not _images(scene / "rgb")]:
            raise InputError(
                f"dataset: {lacking[0]} has no scene_camera.json beside rgb/<number>.png or .jpg, nor a folder in it"
            )
        self._names_file = names
        self._names = None if names is None else read_object_names(as_path(names, "names"))

    def read(self, number: int) -> tuple[RGBDFrame, dict[int, str], dict[str, str]]:
        """Read a frame, the names of its scored instances and its scene.

        Raises:
            InputError: a table has no entry for the image or an object; also as indexing.
        """
        image = self.sources[number]
        scene = _scene(image)
        objects = _values(image, "gt", "obj_id", int)
        visible = [1.0] * len(objects)
        if _table(image, "gt_info").exists():
            visible = _values(image, "gt_info", "visib_fract", (int, float))
        if len(visible) != len(objects):
            raise InputError(f"{_table(image, 'gt_info')} has {len(visible)} instances, scene_gt.json {len(objects)}")
        color, depth, intrinsics = _read_images(image)
        masks = [_mask(scene / MASKS / f"{image.stem}_{k:06d}.png", depth) for k in range(len(objects))]
        sizes = [int(mask.sum()) for mask in masks]
        labels = np.zeros(depth.shape, np.int32)
        for k in sorted(range(len(masks)), key=lambda k: -sizes[k]):
            labels[masks[k]] = k + 1
        scored = [k for k in range(len(objects)) if sizes[k] > 0 and visible[k] >= SMALLEST_VISIBLE]
        truth = {k + 1: self._name(objects[k]) for k in scored}
        return RGBDFrame(color, depth, labels, intrinsics), truth, {"scene": scene.name}

    def read_frame(self, number: int) -> RGBDFrame:
        """Read a frame, with labels if its scene has ground truth and masks; raise errors as `read`.

        BOP keeps both back for some test sets.
        """
        image = self.sources[number]
        if _table(image, "gt").exists() and (_scene(image) / MASKS).exists():
            return self.read(number)[0]
        color, depth, intrinsics = _read_images(image)
        return RGBDFrame(color, depth, None, intrinsics)

    def files(self, number: int) -> list[Path]:
        """Return the files of a frame: its images, its masks and the tables of its scene."""
        image = self.sources[number]
        scene, tables = _scene(image), [_table(image, name) for name in ("camera", "gt", "gt_info")]
        masks = sorted((scene / MASKS).glob(f"{image.stem}_*.png"))
        return [image, scene / "depth" / f"{image.stem}.png", *masks, *(table for table in tables if table.exists())]

    def names(self) -> Iterator[str]:
        """Yield the names of the objects in all scenes, frame by frame."""
        for image in self.sources:
            yield from map(self._name, _values(image, "gt", "obj_id", int))

    def _name(self, obj_id: int) -> str:
        if self._names is None:
            return f"obj_{obj_id:06d}"
        if obj_id not in self._names:
            raise InputError(f"{self._names_file} lacks the obj_id {obj_id}")
        return self._names[obj_id]


def _scene(image: Path) -> Path:
    return image.parent.parent


def _table(image: Path, name: str) -> Path:
    return _scene(image) / f"scene_{name}.json"


@contextlib.contextmanager
def _entry(image: Path, name: str) -> Iterator[Any]:
    """Yield the entry of an image in a table of its scene; errors name the table."""
    path, number = _table(image, name), str(int(image.stem))
    status = path.stat()
    table = _read_table(path, status.st_mtime_ns, status.st_size)
    with with_context(str(path)):
        if number not in table:
            raise InputError(f"it has no image {number}")
        yield table[number]


@functools.lru_cache(maxsize=3)  # frames are read scene by scene
def _read_table(path: Path, modified: int, size: int) -> dict[Any, Any]:
    return read_table(path)


def _mask(path: Path, depth: NDArray[Any]) -> NDArray[np.bool_]:
    mask = read_labels(path) > 0
    if mask.shape != depth.shape:
        raise InputError(f"{path} has shape {mask.shape}; depth has {depth.shape}")
    return mask


def _images(folder: Path) -> list[Path]:
    """Return the images of a scene by number; one that is there as JPEG and PNG counts once."""
    files = {int(f.stem): f for f in sorted(folder.glob("*")) if f.suffix in (".png", ".jpg") and f.stem.isdecimal()}
    return [files[number] for number in sorted(files)]


def read_object_names(path: Path) -> dict[int, str]:
    """Read a YAML or JSON table obj_id -> name.

    Raises:
        InputError: the table is damaged or has other entries; the message names the file.
        OSError: the file cannot be opened.
    """
    items = read_table(path).items()  # the keys of JSON are strings
    return named_labels(path, [(int(key) if str(key).isdecimal() else str(key), name) for key, name in items])


def _values(image: Path, name: str, key: str, kind: type | tuple[type, ...]) -> list[Any]:
    """Return the value of `key` of each instance of an image in a table of its scene."""
    with _entry(image, name) as entry:
        try:
            values = [instance[key] for instance in entry]
        except (TypeError, KeyError):
            raise InputError(f"an image's entry is not a list of {{{key}: <number>, ...}}") from None
        if invalid := [value for value in values if not isinstance(value, kind) or isinstance(value, bool)]:
            raise InputError(f"{key} is {invalid[0]!r}; expected a number")
        return values


def _read_images(image: Path) -> tuple[NDArray[np.uint8], NDArray[Any], Intrinsics]:
    """Return the colour, the depth and the camera of an image."""
    with _entry(image, "camera") as entry:
        if not isinstance(entry, dict) or not entry.keys() >= {"cam_K", "depth_scale"}:
            raise InputError("an image's entry is not {cam_K: <9 numbers>, depth_scale: <number>, ...}")
        camera = Intrinsics.of(entry)
    return read_color(image), read_depth(_scene(image) / "depth" / f"{image.stem}.png"), camera
