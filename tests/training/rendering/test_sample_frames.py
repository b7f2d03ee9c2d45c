"""The packaged sample frames are up to date and small."""

import json
from pathlib import Path

import numpy as np
import pytest
from image_files import SAMPLES

from training.readers.frames import frame_files
from training.rendering.sample_frames import write_sample_frames


@pytest.mark.slow
def test_packaged_samples_are_up_to_date(tmp_path: Path) -> None:
    write_sample_frames(tmp_path)
    index = json.loads((tmp_path / "index.json").read_text())
    assert index == json.loads((SAMPLES / "index.json").read_text())
    for one in index:
        rendered, packaged = (frame_files(root / one["folder"]).read() for root in (tmp_path, SAMPLES))
        assert rendered.intrinsics == packaged.intrinsics
        # Ray casting and JPEG may round differently on other machines.
        for name, tolerance in (("labels", 0), ("depth", 1), ("color", 4)):
            difference = np.abs(getattr(rendered, name).astype(int) - getattr(packaged, name))
            assert (difference <= tolerance).mean() > 0.999, (one, name)
