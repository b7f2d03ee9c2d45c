"""Recordings as sources of frames."""

import functools
import weakref
from pathlib import Path

import numpy as np
import pytest
from recording_files import table_frame, write_recording

from thor2_jax.errors import InputError
from thor2_jax.recordings.bags import Bag
from training.readers.frame_files import recorded_sources

FRAMES = [table_frame(k) for k in range(3)]


@pytest.mark.parametrize("every", [1, 2])
def test_frames_are_read_in_any_order(tmp_path: Path, every: int) -> None:
    path = write_recording(tmp_path / "a.mcap", FRAMES)
    opened: list[weakref.ref[Bag]] = []

    def open_bag() -> Bag:
        bag = Bag(path)
        opened.append(weakref.ref(bag))
        return bag

    sources, notes = recorded_sources(open_bag, every)
    assert not notes
    assert len({source.name for source in sources}) == len(sources) == len(FRAMES[::every])
    for number in (0, 1, 1, 0, len(sources) - 1):
        frame, expected = sources[number].read(), FRAMES[::every][number]
        np.testing.assert_array_equal(frame.color, expected.color)
        assert frame.labels is None
    del sources
    assert opened and all(bag() is None for bag in opened)  # closed at once, not by a later garbage collection


def test_a_damaged_recording_has_the_frames_before(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "a.mcap", [table_frame(k) for k in range(8)])
    path.write_bytes(path.read_bytes()[: -(10**6)])
    sources, (note,) = recorded_sources(functools.partial(Bag, path))
    assert "mcap recover" in note and 0 < len(sources) < 8 and sources[-1].read().color.shape == FRAMES[0].color.shape
    (tmp_path / "b.mcap").write_bytes(b"damaged")
    with pytest.raises(InputError, match="damaged"):
        recorded_sources(functools.partial(Bag, tmp_path / "b.mcap"))
