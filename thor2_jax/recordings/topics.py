"""Choice of the topics of a recording by name or content, and pairing of colour and depth images by time stamp."""

import dataclasses
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from thor2_jax.errors import InputError
from thor2_jax.printable import first_names

__all__ = ["DEFAULT_MAX_GAP", "PairCounts", "StampedImage", "Topics", "choose_topics", "nearest_pairs"]

_EXPECTED = {
    "color": "8-bit colour images",
    "depth": "depth images (16UC1 or 32FC1)",
    "camera": "sensor_msgs/CameraInfo",
}
"""Kind of a topic -> description of its content."""

_ALIGNED = ("aligned", "registered")
"""Parts of the names of topics with depth registered to colour."""


@dataclasses.dataclass(frozen=True)
class Topics:
    """Topics of a recording.

    Attributes:
        color: colour images.
        depth: depth images, registered to colour.
        camera: intrinsics of the colour camera; None if a file gives them.
    """

    color: str | None = None
    depth: str | None = None
    camera: str | None = None


def choose_topics(
    wanted: Topics, kinds: Mapping[str, str], types: Mapping[str, Any], *, needs_camera: bool = True
) -> Topics:
    """Return the topics to read.

    Args:
        wanted: requested names of topics; topics that are None are chosen.
        kinds: topic -> "color", "depth", "camera" or "other", for all topics with messages.
        types: topic -> message type and what else is known of its content, for all topics; used in error messages.
        needs_camera: whether intrinsics are needed.

    Raises:
        InputError: a topic does not exist or has other content, no topic fits, or several topics fit.
    """
    color = _choose("color", wanted.color, kinds, types)
    depth = _choose("depth", wanted.depth, kinds, types)
    camera = wanted.camera
    if camera is None:
        if not needs_camera:
            return Topics(color, depth)
        siblings = [f"{_uncompressed(topic).rpartition('/')[0]}/camera_info" for topic in (color, depth)]
        camera = next((topic for topic in siblings if kinds.get(topic) == "camera"), None)
    return Topics(color, depth, _choose("camera", camera, kinds, types))


def _uncompressed(topic: str) -> str:
    base, _, transport = topic.rpartition("/")
    return base if transport.lower() in ("compressed", "compresseddepth") else topic


def _choose(kind: str, wanted: str | None, kinds: Mapping[str, str], types: Mapping[str, Any]) -> str:
    option = f"{kind}_topic"
    if wanted is not None:
        topic = wanted if wanted in types else f"/{wanted}"
        if topic not in types:
            raise InputError(f"{option} is {wanted}; expected one of the recording's topics: {_listed(types)}")
        if kinds.get(topic) != kind:
            raise InputError(f"{option} is {wanted}, which holds {types[topic]}; expected {_EXPECTED[kind]}")
        return topic
    candidates = [topic for topic, held in kinds.items() if held == kind]
    if kind == "depth":
        candidates = [topic for topic in candidates if any(word in topic for word in _ALIGNED)] or candidates
    candidates = [
        topic for topic in candidates if _uncompressed(topic) == topic or _uncompressed(topic) not in candidates
    ]
    if not candidates:
        advice = "; or give the file of the intrinsics" if kind == "camera" else ""
        raise InputError(
            f"{option}: no topic holds {_EXPECTED[kind]}; the recording has {_listed(types)}; record one{advice}"
        )
    if len(candidates) > 1:
        raise InputError(f"{option} is not given, and {', '.join(sorted(candidates))} hold {_EXPECTED[kind]}; give one")
    return candidates[0]


def _listed(types: Mapping[str, Any]) -> str:
    return first_names([f"{name} ({types[name]})" for name in sorted(types)], 12) or "no topic"


DEFAULT_MAX_GAP = 0.03
"""Default of the largest time between the images of a pair, seconds: about one period at 30 frames per second."""

LONGEST_WAIT = 2 * 10**9
"""Largest delay, nanoseconds, with which an image may arrive in the recording after the others and still be paired."""


class StampedImage(NamedTuple):
    """An image of a recording.

    Attributes:
        is_color: whether the image belongs to the colour stream, otherwise to the depth stream.
        stamp: time at which the image was taken, nanoseconds.
        arrival: time at which the image was recorded, nanoseconds.
        message: the message.
    """

    is_color: bool
    stamp: int
    arrival: int
    message: Any


class PairCounts:
    """Counts of `nearest_pairs` so far.

    Attributes:
        color: number of colour images.
        depth: number of depth images.
        pairs: number of pairs.
        smallest_gap: smallest time between a colour and a depth image, nanoseconds; None if there are no such images.
    """

    def __init__(self) -> None:
        self.color = 0
        self.depth = 0
        self.pairs = 0
        self.smallest_gap: int | None = None


def nearest_pairs(
    images: Iterable[StampedImage], tolerance: int, counts: PairCounts
) -> Iterator[tuple[StampedImage, StampedImage]]:
    """Yield each colour image with the depth image that is nearest in time, at most `tolerance` away.

    The images of each stream are in the order of their time stamps. A depth image may belong to several colour images.

    Args:
        images: both streams, in the order in which they were recorded.
        tolerance: largest time between the two images of a pair, nanoseconds.
        counts: counts that are updated while the pairs are read.
    """
    colors: deque[StampedImage] = deque()
    depths: deque[StampedImage] = deque()

    def resolve(color: StampedImage) -> Iterator[tuple[StampedImage, StampedImage]]:
        if not depths:
            return
        # Of depth images with the same time stamp, the one that was recorded next to the colour image is taken.
        nearest = min(depths, key=lambda depth: (abs(depth.stamp - color.stamp), abs(depth.arrival - color.arrival)))
        while depths[0] is not nearest:  # nor is it nearest to a later colour image
            depths.popleft()
        gap = abs(nearest.stamp - color.stamp)
        counts.smallest_gap = gap if counts.smallest_gap is None else min(gap, counts.smallest_gap)
        if gap <= tolerance:
            counts.pairs += 1
            yield color, nearest

    for image in images:
        if image.is_color:
            counts.color += 1
            colors.append(image)
        else:
            counts.depth += 1
            depths.append(image)
        while colors and (
            (depths and depths[-1].stamp >= colors[0].stamp) or abs(image.arrival - colors[0].arrival) > LONGEST_WAIT
        ):
            yield from resolve(colors.popleft())
        while len(depths) > 1 and abs(image.arrival - depths[0].arrival) > LONGEST_WAIT:
            depths.popleft()
    while colors:
        yield from resolve(colors.popleft())
