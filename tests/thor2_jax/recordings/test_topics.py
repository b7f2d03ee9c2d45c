"""Choice of topics, and pairs of colour and depth images by the nearest time stamp."""

import numpy as np
import pytest
from refusals import assert_refused

from thor2_jax.recordings.topics import LONGEST_WAIT, PairCounts, StampedImage, Topics, choose_topics, nearest_pairs

MS = 10**6


def test_choice_of_topics() -> None:
    kinds = {"/c": "color", "/c/compressed": "color", "/d": "depth", "/aligned/d": "depth", "/camera_info": "camera"}
    types = dict.fromkeys(kinds, "sensor_msgs/msg/Image")
    assert choose_topics(Topics(), kinds, types) == Topics("/c", "/aligned/d", "/camera_info")
    assert choose_topics(Topics(), kinds, types, needs_camera=False) == Topics("/c", "/aligned/d")
    assert choose_topics(Topics("/c/compressed", "d"), kinds, types).depth == "/d"
    for wanted, message in (
        (Topics("/x"), "expected one of"),
        (Topics("/d"), "expected 8-bit colour"),
        (Topics(camera="/c"), "CameraInfo"),
    ):
        assert_refused(message, choose_topics, wanted, kinds, types)
    assert_refused("no topic holds", choose_topics, Topics(), {}, {})


def pairs_of(images: list[StampedImage], tolerance: int) -> tuple[list[tuple[int, int]], PairCounts]:
    counts = PairCounts()
    return [(color.stamp, depth.stamp) for color, depth in nearest_pairs(images, tolerance, counts)], counts


@pytest.mark.parametrize("seed", range(20))
def test_pairs_equal_those_of_all_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    images, stamps = [], {}
    for is_color, period in ((True, 33), (False, int(rng.integers(15, 120)))):
        stamps[is_color] = np.cumsum(rng.uniform(0.5, 1.5, 60) * period * MS).astype(int).tolist()
        late = int(rng.integers(0, 300)) * MS
        images += [StampedImage(is_color, stamp, stamp + late, None) for stamp in stamps[is_color]]
    images.sort(key=lambda image: image.arrival)
    tolerance = 15 * MS
    nearest = [(color, min(stamps[False], key=lambda depth: abs(depth - color))) for color in stamps[True]]
    expected = [(color, depth) for color, depth in nearest if abs(depth - color) <= tolerance]
    pairs, counts = pairs_of(images, tolerance)
    assert pairs == expected
    assert (counts.color, counts.depth, counts.pairs) == (60, 60, len(expected))


def test_single_streams_and_streams_with_other_clocks_are_not_paired() -> None:
    hour = 3600 * 10**9
    for is_color in (True, False):
        pairs, counts = pairs_of([StampedImage(is_color, k, k, None) for k in range(3)], MS)
        assert pairs == [] and counts.smallest_gap is None
    for shift in (hour, -hour):
        images = []
        for arrival in range(0, 200 * 33 * MS, 33 * MS):
            images += [StampedImage(True, arrival, arrival, None), StampedImage(False, arrival + shift, arrival, None)]
        pairs, counts = pairs_of(images, 30 * MS)
        assert pairs == [] and counts.color == counts.depth == 200
        assert counts.smallest_gap is not None and abs(counts.smallest_gap - hour) < 2 * LONGEST_WAIT + 7 * 10**9


def test_equal_time_stamps_are_paired_by_arrival() -> None:
    images = [StampedImage(is_color, 1, 33 * k * MS, k) for k in range(200) for is_color in (False, True)]
    pairs = list(nearest_pairs(images, MS, PairCounts()))
    assert [color.message for color, _ in pairs] == [depth.message for _, depth in pairs] == list(range(200))


def test_a_clock_that_is_set_back_delays_no_pairs() -> None:
    times = [start + 33 * k * MS for start in (3600 * 10**9, 0) for k in range(100)]
    images = [StampedImage(is_color, time, time, None) for time in times for is_color in (True, False)]
    remaining = iter([*images[:199], *images[200:]])  # the last colour image of the first clock has no depth
    pairs = nearest_pairs(remaining, 15 * MS, PairCounts())
    assert [next(pairs)[0].stamp for _ in range(100)][-1] == 33 * MS and next(remaining, None) is not None
