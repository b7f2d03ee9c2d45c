"""Square crops of colour and surface normals, which are the input of RGB-D image networks.

    color, normals = rgbd_crop(frame, label)         # [224, 224, 3] each

A rendered view is cropped alike (`rgbd_crop(view.frame, 1)`).
"""

import dataclasses
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError, decoding
from thor2_jax.frames.frames import RGBDFrame, pixel_rays
from training.storage.jobs import MANIFEST
from training.views.mesh_views import ViewTask, all_views

__all__ = ["CROPS", "CROPS_FORMAT", "CROP_SIZE", "Crop", "ViewCrops", "crops_of", "read_crop_manifest", "rgbd_crop"]

CROP_SIZE = 224
"""Side of a crop, pixels."""

_WINDOW = 5
"""Side of the median window for filling depth, pixels."""


Crop = tuple[NDArray[np.uint8], NDArray[np.int8]]
"""Colour and normals of an instance that fills a square, in the format of `ViewCrops`, [S, S, 3] each."""


def rgbd_crop(frame: RGBDFrame, label: int, size: int = CROP_SIZE) -> Crop:
    """Crop an instance: its bounding box, centred and padded to a square, then resized.

    Missing depth is filled with `fill_depth`. Resized pixels are means over pixels of the instance only, so that the
    outline has no dark rim.

    Args:
        frame: frame with labels.
        label: label number of an instance; at least one of its pixels must have depth.
        size: side of the crop, pixels, at least 1.
    """
    pixels = frame.instance_pixels[label]
    width = frame.depth.shape[1]
    rows, columns = np.divmod(pixels, width)
    side = int(max(np.ptp(rows), np.ptp(columns))) + 1
    top, left = (int(v.min()) - (side - 1 - int(np.ptp(v))) // 2 for v in (rows, columns))
    inside = rows - top, columns - left
    mask, depth = np.zeros((side, side), bool), np.zeros((side, side), np.float32)
    color, rays = np.zeros((side, side, 3), np.float32), np.zeros((side, side, 3))
    mask[inside] = True
    depth[inside] = frame.depth_m.ravel()[pixels]
    color[inside] = frame.color.reshape(-1, 3)[pixels] / np.float32(255)
    rays[inside] = pixel_rays(pixels, width, frame.intrinsics)
    normals = surface_normals(rays * fill_depth(depth, mask)[..., None], mask)
    coverage = _resized(mask.astype(np.float32), size)
    shown = coverage >= 0.5
    weight = np.where(shown, coverage, 1)[..., None]
    color = np.where(shown[..., None], np.clip(_resized(color, size) / weight, 0, 1), 0)
    normals = np.where(shown[..., None], _unit(_resized(normals, size)), 0)
    return np.rint(color * 255).astype(np.uint8), np.rint(normals * 127).astype(np.int8)


def fill_depth(depth: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the depth of an instance without holes: a recursive median over windows of 5 x 5 pixels.

    In each pass, a hole with known pixels in its window gets the median of these pixels. Parts of the instance that no
    pass reaches get the median of all its depths.

    Args:
        depth: [h, w] depth, 0 where it is missing; at least one pixel of the mask has depth.
        mask: [h, w] pixels of the instance; others are neither read nor filled.

    Returns:
        [h, w] depth, above 0 on the mask and 0 elsewhere.
    """
    filled = np.where(mask & (depth > 0), depth, np.float32(np.nan))
    rows, columns = np.nonzero(mask & np.isnan(filled))
    while len(rows):
        padded = np.pad(filled, _WINDOW // 2, constant_values=np.nan)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW, _WINDOW))
        around = windows[rows, columns].reshape(len(rows), -1)
        known = ~np.isnan(around).all(axis=1)
        if not known.any():
            filled[rows, columns] = np.nanmedian(filled)
            break
        filled[rows[known], columns[known]] = np.nanmedian(around[known], axis=1)
        rows, columns = rows[~known], columns[~known]
    return np.where(mask, filled, np.float32(0))


def surface_normals(points: NDArray[np.floating], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the unit normals of an organized cloud, towards the camera at the origin.

    A normal is the cross product of the mean steps along the row and along the column to neighbours in the mask.
    Without neighbours in one of the two directions, it points to the camera.

    Args:
        points: [h, w, 3] points in the OpenCV camera frame, metres.
        mask: [h, w] pixels with a point.

    Returns:
        [h, w, 3] float32; 0 outside the mask.
    """
    exact = points.astype(np.float64)
    normals = np.cross(_mean_step(exact, mask, 0), _mean_step(exact, mask, 1))
    towards = -_unit(exact)
    lacking = ~normals.any(axis=-1)
    normals[lacking] = towards[lacking]
    normals *= np.where((normals * towards).sum(axis=-1) < 0, -1, 1)[..., None]
    return np.where(mask[..., None], _unit(normals), 0).astype(np.float32)


def _mean_step(points: NDArray[np.float64], mask: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """Return the mean of the steps from the pixel before and to the pixel after, along an axis [h, w, 3]."""
    points, mask = np.moveaxis(points, axis, 0), np.moveaxis(mask, axis, 0)
    known = mask[1:] & mask[:-1]
    steps = np.where(known[..., None], points[1:] - points[:-1], 0)
    total, count = np.zeros_like(points), np.zeros(mask.shape)
    for part in (slice(None, -1), slice(1, None)):
        total[part] += steps
        count[part] += known
    return np.moveaxis(total / np.maximum(count, 1)[..., None], 0, axis)


def _unit(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1)


def _resized(image: NDArray[np.float32], size: int) -> NDArray[np.float32]:
    """Return an image [h, w] or [h, w, C] resized to a square; it is area-filtered like in Pillow if it shrinks."""
    planes = np.moveaxis(np.atleast_3d(image), -1, 0)
    images = (Image.fromarray(np.ascontiguousarray(plane)) for plane in planes)
    resized = [np.asarray(each.resize((size, size), Image.Resampling.BILINEAR)) for each in images]
    return np.stack(resized, axis=-1).reshape(size, size, *image.shape[2:])


@dataclasses.dataclass(frozen=True)
class ViewCrops:
    """Crops of several views, [V, S, S, 3] each; the background is 0 in both.

    Attributes:
        color: uint8 sRGB.
        normals: int8 unit normals times 127, OpenCV camera frame, towards the camera; not all 0 on the instance.
    """

    color: NDArray[np.uint8]
    normals: NDArray[np.int8]

    @staticmethod
    def stacked(crops: Sequence[Crop], size: int) -> "ViewCrops":
        """Return crops of `size` pixels, possibly none, as one record."""
        shape = (len(crops), size, size, 3)
        color, normals = (np.reshape([crop[k] for crop in crops], shape) for k in (0, 1))
        return ViewCrops(color.astype(np.uint8, copy=False), normals.astype(np.int8, copy=False))

    def __len__(self) -> int:
        return len(self.color)

    @property
    def content(self) -> bytes:
        """Bytes of a file of crops."""
        stream = io.BytesIO()
        np.savez_compressed(stream, color=self.color, normals=self.normals)
        return stream.getvalue()

    def reduced(self, size: int) -> "ViewCrops":
        """Return the crops area-filtered to sides of `size` pixels; the same record if they already have this size."""
        if size == self.color.shape[1]:
            return self

        def smaller(images: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
            return [np.asarray(Image.fromarray(each).resize((size, size), Image.Resampling.BOX)) for each in images]

        shifted = smaller((self.normals.astype(np.int16) + 127).astype(np.uint8))
        normals = [(each.astype(np.int16) - 127).astype(np.int8) for each in shifted]
        return ViewCrops.stacked(list(zip(smaller(self.color), normals, strict=True)), size)


CROPS = "crops"
"""Directory of the crops in the directory of a dataset."""

CROPS_FORMAT = 1


def read_crop_manifest(directory: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the job of a directory of crops (their size, and the digest of their dataset) and file name -> SHA-256.

    Raises:
        InputError: the manifest is missing, damaged or of another format.
    """
    if not (path := directory / MANIFEST).is_file():
        raise InputError(
            f"dataset: {directory.parent} has no crops, which the networks are trained on; render them: repeat its "
            "`thor2 render` command with --crops"
        )
    with decoding(f"dataset: {path} is damaged", advice=f"delete {directory} and render the crops again"):
        content = json.loads(path.read_bytes())
        if content["format"] != CROPS_FORMAT:
            raise ValueError(f"its format is {content['format']!r}; expected {CROPS_FORMAT}")
        return {"crops": int(content["size"]), "dataset": str(content["dataset"])}, dict(content["files"])


def crops_of(task: ViewTask, size: int) -> dict[tuple[int, int], Crop]:
    """Return (number of the view, number of the copy) -> crop for the views of a task that are not empty."""
    return {(k, copy): rgbd_crop(view.frame, 1, size) for k, copy, view in all_views(task) if view.depth.any()}
