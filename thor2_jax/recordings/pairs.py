"""Pairs of colour and depth images by the nearest time stamp."""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

__all__ = ["DEFAULT_MAX_GAP", "ImagePair", "PairCounts", "StampedImage", "nearest_pairs"]

DEFAULT_MAX_GAP = 0.03
"""Default of the largest time between the images of a pair, seconds: about a period at 30 frames a second."""

LONGEST_WAIT = 2 * 10**9
"""How much later than the others, in nanoseconds, an image may arrive in the recording to be paired still."""


class StampedImage(NamedTuple):
    """An image of a recording.

    Attributes:
        is_color: whether it is of the colour stream; the depth stream otherwise.
        stamp: time at which it was taken, nanoseconds.
        arrival: time at which it was recorded, nanoseconds.
        message: the message.
    """

    is_color: bool
    stamp: int
    arrival: int
    message: Any


class ImagePair(NamedTuple):
    """A colour image and the depth image that is nearest to it in time."""

    color: StampedImage
    depth: StampedImage


class PairCounts:
    """Counts of `nearest_pairs` so far.

    Attributes:
        color: number of colour images.
        depth: number of depth images.
        pairs: number of pairs.
        smallest_gap: smallest time between a colour image and a depth image, nanoseconds; None if there was none.
    """

    def __init__(self) -> None:
        self.color = 0
        self.depth = 0
        self.pairs = 0
        self.smallest_gap: int | None = None


def nearest_pairs(images: Iterable[StampedImage], tolerance: int, counts: PairCounts) -> Iterator[ImagePair]:
    """Pair each colour image with the depth image that is nearest in time.

    The images of each stream are in the order of their time stamps. A depth image may belong to several colour images.

    Args:
        images: both streams, in the order in which they were recorded.
        tolerance: largest time between the two images of a pair, nanoseconds.
        counts: is filled while the pairs are drawn.
    """
    colors: deque[StampedImage] = deque()
    depths: deque[StampedImage] = deque()
    latest = None  # time stamp of the latest colour image

    def resolve(color: StampedImage) -> Iterator[ImagePair]:
        if not depths:
            return
        nearest = min(depths, key=lambda depth: abs(depth.stamp - color.stamp))
        gap = abs(nearest.stamp - color.stamp)
        counts.smallest_gap = gap if counts.smallest_gap is None else min(gap, counts.smallest_gap)
        if gap <= tolerance:
            counts.pairs += 1
            yield ImagePair(color, nearest)

    for image in images:
        if image.is_color:
            counts.color += 1
            colors.append(image)
            latest = image.stamp
        else:
            counts.depth += 1
            depths.append(image)
        while colors and (
            (depths and depths[-1].stamp >= colors[0].stamp) or image.arrival - colors[0].arrival > LONGEST_WAIT
        ):
            yield from resolve(colors.popleft())
        earliest = colors[0].stamp if colors else latest
        # Colour images to come are later, so of the depth images before `earliest` only the last one can be nearest.
        while len(depths) > 1 and (
            (earliest is not None and depths[1].stamp <= earliest) or image.arrival - depths[0].arrival > LONGEST_WAIT
        ):
            depths.popleft()
    while colors:
        yield from resolve(colors.popleft())
