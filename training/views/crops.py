"""Square crops of colour and surface normals, the input of RGB-D image networks.

    crop = rgbd_crop(frame, label)
    crop.color, crop.normals, crop.mask         # [224, 224, 3], [224, 224, 3], [224, 224]

A rendered view is cropped alike (`rgbd_crop(view.frame, 1)`). Image networks are trained on the crops of the views of a
dataset (`ViewDataset.read_crops`).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.frames.frames import RGBDFrame, pixel_rays

__all__ = [
    "CROP_SIZE",
    "QuantizedCrop",
    "ViewCrops",
    "fill_depth",
    "quantized",
    "rgbd_crop",
    "stacked",
    "surface_normals",
]

CROP_SIZE = 224
"""Side of a crop, pixels."""

_WINDOW = 5
"""Side of the window of the median that fills depth, pixels."""


@dataclasses.dataclass(frozen=True, eq=False)
class RGBDCrop:
    """An instance, resized to fill a square; what is not the instance is 0.

    Attributes:
        color: [S, S, 3] float32 sRGB in [0, 1].
        normals: [S, S, 3] float32 unit normals of the surface in the OpenCV camera frame, towards the camera.
        mask: [S, S] pixels of the instance.
    """

    color: NDArray[np.float32]
    normals: NDArray[np.float32]
    mask: NDArray[np.bool_]


def rgbd_crop(frame: RGBDFrame, label: int, size: int = CROP_SIZE) -> RGBDCrop:
    """Crop an instance: its bounding box, centred and padded to a square, then resized.

    Missing depth is filled with `fill_depth`. Pixels that the resizing mixes have the mean of the instance's part only,
    so that the outline has no dark rim.

    Args:
        frame: frame with labels.
        label: label number of an instance, of which some pixel has depth.
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
    return RGBDCrop(color, np.where(shown[..., None], _unit(_resized(normals, size)), 0), shown)


def fill_depth(depth: NDArray[np.float32], mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return the depth of an instance without holes: a recursive median over windows of 5 x 5 pixels.

    In each pass, holes with a known pixel in their window get the median of these pixels. Parts of the instance that no
    pass reaches have the median of all its depths.

    Args:
        depth: [h, w] depth, 0 where there is none; some pixel of the mask has depth.
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

    A normal is the cross product of the mean steps to the neighbours along the row and along the column, of those that
    are in the mask. Without neighbours in one of the directions it points to the camera.

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
    """Return an image [h, w] or [h, w, C] resized to a square; smaller ones are area-filtered, as Pillow does."""
    planes = image[..., None] if image.ndim == 2 else image
    resized = [
        np.asarray(Image.fromarray(np.ascontiguousarray(plane)).resize((size, size), Image.Resampling.BILINEAR))
        for plane in np.moveaxis(planes, -1, 0)
    ]
    return np.stack(resized, axis=-1).reshape(size, size, *image.shape[2:])


QuantizedCrop = tuple[NDArray[np.uint8], NDArray[np.int8]]
"""Colour and normals of a crop as `ViewCrops` holds them, [S, S, 3] each."""


@dataclasses.dataclass(frozen=True)
class ViewCrops:
    """Crops of several views, [V, S, S, 3] each; the background is 0 in both.

    Attributes:
        color: uint8 sRGB.
        normals: int8 unit normals times 127, OpenCV camera frame, towards the camera; not all 0 on the instance.
    """

    color: NDArray[np.uint8]
    normals: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.color)

    @property
    def size(self) -> int:
        """Side of a crop, pixels."""
        return int(self.color.shape[1])

    def reduced(self, size: int) -> "ViewCrops":
        """Return the crops with sides of `size` pixels, area-filtered; the same record if they have this size."""
        if size == self.size:
            return self

        def smaller(images: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
            return [np.asarray(Image.fromarray(each).resize((size, size), Image.Resampling.BOX)) for each in images]

        shifted = smaller((self.normals.astype(np.int16) + 127).astype(np.uint8))
        normals = [(each.astype(np.int16) - 127).astype(np.int8) for each in shifted]
        return stacked(list(zip(smaller(self.color), normals, strict=True)), size)


def quantized(crop: RGBDCrop) -> QuantizedCrop:
    """Return the colour and the normals of a crop as `ViewCrops` holds them."""
    return np.rint(crop.color * 255).astype(np.uint8), np.rint(crop.normals * 127).astype(np.int8)


def stacked(crops: Sequence[QuantizedCrop], size: int) -> ViewCrops:
    """Return quantized crops of `size` pixels as one record; there may be none."""
    shape = (len(crops), size, size, 3)
    record = ViewCrops(np.zeros(shape, np.uint8), np.zeros(shape, np.int8))
    for row, (color, normals) in enumerate(crops):
        record.color[row], record.normals[row] = color, normals
    return record
