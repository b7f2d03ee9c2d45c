"""Crops of the views of a dataset, which image networks are trained on; `render_crops` writes them.

    crops = ViewDataset.open("views").read_crops(0, 96)      # one crop for each cloud of `read(0)`

DATASET/crops/manifest.json     size of the crops, digest of the dataset, checksums of the files
DATASET/crops/*.npz             one file for each shard, with compressed `color` and `normals`
"""

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from thor2_jax.errors import InputError
from thor2_jax.files import write_text
from training.views.crops import RGBDCrop

__all__ = [
    "CROPS",
    "MANIFEST",
    "CropManifest",
    "QuantizedCrop",
    "ViewCrops",
    "crop_file",
    "encode_crops",
    "intact_content",
    "quantized",
    "read_crops",
    "repeated",
    "stacked",
]

CROPS = "crops"
"""Directory of the crops in the directory of a dataset."""

MANIFEST = "manifest.json"
MANIFEST_FORMAT = 1

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
        color = [Image.fromarray(image).resize((size, size), Image.Resampling.BOX) for image in self.color]
        shifted = (self.normals.astype(np.int16) + 127).astype(np.uint8)
        normals = [Image.fromarray(image).resize((size, size), Image.Resampling.BOX) for image in shifted]
        pairs = [
            (np.asarray(c), (np.asarray(n).astype(np.int16) - 127).astype(np.int8))
            for c, n in zip(color, normals, strict=True)
        ]
        return stacked(pairs, size)


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


def repeated(crops: ViewCrops, times: int) -> ViewCrops:
    """Return the crops, each `times` times in a row."""
    return ViewCrops(np.repeat(crops.color, times, axis=0), np.repeat(crops.normals, times, axis=0))


def encode_crops(crops: ViewCrops) -> bytes:
    """Return the bytes of a file of crops."""
    stream = io.BytesIO()
    np.savez_compressed(stream, color=crops.color, normals=crops.normals)
    return stream.getvalue()


@dataclasses.dataclass(frozen=True)
class CropManifest:
    """The crops of a dataset.

    Attributes:
        size: side of the crops, pixels.
        dataset: digest of the dataset.
        files: file name -> SHA-256 of the finished files.
    """

    size: int
    dataset: str
    files: Mapping[str, str]

    def write(self, directory: Path) -> None:
        """Write the manifest to the directory of the crops; raises OSError."""
        write_text(directory / MANIFEST, json.dumps({"format": MANIFEST_FORMAT, **dataclasses.asdict(self)}) + "\n")

    @classmethod
    def read(cls, directory: Path) -> "CropManifest":
        """Read the manifest in the directory of the crops.

        Raises:
            InputError: it is missing, damaged or of another format.
        """
        path = directory / MANIFEST
        try:
            content = json.loads(path.read_bytes())
            if content["format"] != MANIFEST_FORMAT:
                raise ValueError(f"its format is {content['format']!r}; expected {MANIFEST_FORMAT}")
            return cls(int(content["size"]), str(content["dataset"]), dict(content["files"]))
        except OSError:
            raise InputError(
                f"dataset: {directory.parent} has no crops, which the networks are trained on; render them: repeat its "
                "`thor2 render` command with --crops"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"dataset: {path} is damaged ({error}); delete {directory} and render the crops again"
            ) from None


def crop_file(shard: str) -> str:
    """Return the file name of the crops of a shard, given its file name."""
    return Path(shard).with_suffix(".npz").name


def intact_content(directory: Path, name: str, sha256: str) -> bytes | None:
    """Return the bytes of a file; None if it is missing or has another checksum."""
    path = directory / name
    content = path.read_bytes() if path.is_file() else b""
    return content if hashlib.sha256(content).hexdigest() == sha256 else None


def read_crops(dataset: Path, digest: str, shard: str, size: int) -> ViewCrops:
    """Read the crops of a shard.

    Args:
        dataset: directory of the dataset.
        digest: its digest.
        shard: file name of the shard.
        size: side of the crops, pixels; larger stored ones are reduced.

    Raises:
        InputError: the dataset has no crops, smaller ones, or a file is missing or damaged.
    """
    directory = dataset / CROPS
    manifest = CropManifest.read(directory)
    if manifest.dataset != digest:
        raise InputError(f"dataset: {directory} has crops of other views; delete it and render the crops again")
    if manifest.size < size:
        raise InputError(
            f"dataset: {directory} has crops of {manifest.size} pixels; expected at least {size}; delete it and render "
            f"with --crops {size}"
        )
    name = crop_file(shard)
    content = intact_content(directory, name, manifest.files[name]) if name in manifest.files else None
    if content is None:
        raise InputError(
            f"dataset: {directory / name} is missing or damaged; repeat `thor2 render` with --crops to restore it"
        )
    try:
        with np.load(io.BytesIO(content)) as arrays:
            return ViewCrops(arrays["color"], arrays["normals"]).reduced(size)
    except (ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"dataset: {directory / name} is damaged ({error}); delete {directory}") from None
