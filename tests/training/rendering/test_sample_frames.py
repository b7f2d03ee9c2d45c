"""The packaged sample frames are up to date and small."""

import json
from pathlib import Path

import numpy as np
import pytest

import thor2_jax
from thor2_jax.frames.frames import RGBDFrame, read_frame
from training.rendering.sample_frames import write_sample_frames

PACKAGED = Path(thor2_jax.__file__).parent / "service" / "page" / "samples"


def read(folder: Path) -> RGBDFrame:
    parts = {"color": "color.jpg", "depth": "depth.png", "labels": "labels.png", "intrinsics": "intrinsics.json"}
    return read_frame(**{part: folder / name for part, name in parts.items()})


@pytest.mark.slow
def test_packaged_samples_are_up_to_date(tmp_path: Path) -> None:
    write_sample_frames(tmp_path)
    index = json.loads((tmp_path / "index.json").read_text())
    assert index == json.loads((PACKAGED / "index.json").read_text())
    for one in index:
        rendered, packaged = read(tmp_path / one["folder"]), read(PACKAGED / one["folder"])
        assert rendered.intrinsics == packaged.intrinsics
        # Ray casting and JPEG may round differently on other machines.
        for name, tolerance in (("labels", 0), ("depth", 1), ("color", 4)):
            difference = np.abs(getattr(rendered, name).astype(int) - getattr(packaged, name))
            assert (difference <= tolerance).mean() > 0.999, (one, name)


def test_samples_are_small_and_cut_to_their_objects() -> None:
    folders = {one["folder"] for one in json.loads((PACKAGED / "index.json").read_text())}
    assert {path.name for path in PACKAGED.iterdir()} == folders | {"index.json"}
    assert sum(path.stat().st_size for path in PACKAGED.rglob("*") if path.is_file()) < 400_000
    for folder in (path for path in PACKAGED.iterdir() if path.is_dir()):
        labels = read(folder).labels
        assert len(np.unique(labels)) > 4
        border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
        assert not border.any() and labels.shape[1] * 3 == labels.shape[0] * 4
