"""Write the sample frames of the service's page: scenes of the built-in objects, cropped to the objects.

python -c "from training.rendering.sample_frames import write_sample_frames as w; w('thor2_jax/service/page/samples')"
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
from PIL import Image

from thor2_jax.frames.frames import RGBDFrame
from training.objects.builtin_objects import builtin_objects
from training.rendering.scenes import compose_scene

__all__ = ["write_sample_frames"]

SAMPLES = (
    ("crockery", "A laid table", 1, 6),
    ("breakfast", "Mugs and a can in line", 3, 5),
    ("tools", "Tools and a sponge", 4, 5),
    ("clutter", "Seven close together", 6, 7),
)
"""Directory, title, seed and number of objects of each sample; selected by eye."""

NOISE = 0.5
"""Factor of the depth noise. Noise dominates the file size; with this factor, four samples have less than 400 kB."""

CROP_MARGIN = 24
"""Margin around the objects, pixels."""

LEAST_WIDTH = 400
"""Smallest width of a sample, pixels; its height is 3/4 of the width."""


def write_sample_frames(directory: str | Path) -> None:
    """Write the frames, and `index.json` with their titles and objects, to a directory; files are overwritten.

    Raises:
        OSError: a file cannot be written.
    """
    directory, objects = Path(directory), builtin_objects()
    index = []
    for name, title, seed, n_objects in SAMPLES:
        rng = np.random.default_rng(seed)
        scene = compose_scene(objects, rng, n_objects=n_objects, noise=NOISE, light=0.2)
        frame, folder = _crop(scene.frame), directory / name
        folder.mkdir(parents=True, exist_ok=True)
        Image.fromarray(frame.color).save(folder / "color.jpg", quality=85, subsampling=0)
        Image.fromarray(frame.depth).save(folder / "depth.png", optimize=True)
        Image.fromarray(frame.label_image).save(folder / "labels.png", optimize=True)
        known = {name: value for name, value in dataclasses.asdict(frame.intrinsics).items() if value}
        (folder / "intrinsics.json").write_text(json.dumps(known) + "\n")
        index.append({"folder": name, "title": title, "objects": sorted(set(scene.truth.values()))})
    (directory / "index.json").write_text(json.dumps(index, indent=1) + "\n")


def _crop(frame: RGBDFrame) -> RGBDFrame:
    rows, columns = (np.flatnonzero((frame.label_image > 0).any(axis=axis)) for axis in (1, 0))
    required = max(np.ptp(columns) + 1, (np.ptp(rows) + 1) * 4 / 3) + 2 * CROP_MARGIN
    height, width = frame.depth.shape
    across = min(width, max(LEAST_WIDTH, 4 * round(required / 4)))
    down = across * 3 // 4
    left = int(np.clip((columns[0] + columns[-1] - across) // 2, 0, width - across))
    top = int(np.clip((rows[0] + rows[-1] - down) // 2, 0, height - down))
    camera = dataclasses.replace(frame.intrinsics, cx=frame.intrinsics.cx - left, cy=frame.intrinsics.cy - top)
    window = slice(top, top + down), slice(left, left + across)
    return RGBDFrame(frame.color[window], frame.depth[window], frame.label_image[window], camera)
