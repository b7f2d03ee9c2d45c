"""Choice of the topics of a recording: colour, depth and the camera, by name or by content."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from thor2_jax.errors import InputError

__all__ = ["CAMERA_TYPE", "IMAGE_TYPES", "Topics", "choose_topics"]

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"

_ALIGNED = ("aligned", "registered")
"""Parts of the names of topics with depth that is registered to colour."""


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
        wanted: names of topics; those that are None are chosen.
        kinds: topic -> "color", "depth", "camera" or "other", of all topics with messages.
        types: topic -> message type, of all topics; for the error messages.
        needs_camera: whether intrinsics are needed.

    Raises:
        InputError: a topic does not exist or holds something else, none is found, or there are several.
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
            holds = types[topic] if topic in kinds else f"{types[topic]} without messages"
            raise InputError(f"{option} is {wanted}, which holds {holds}; expected {_expected(kind)}")
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
            f"{option}: no topic holds {_expected(kind)}; the recording has {_listed(types)}; record one{advice}"
        )
    if len(candidates) > 1:
        raise InputError(f"{option} is not given, and {', '.join(sorted(candidates))} hold {_expected(kind)}; give one")
    return candidates[0]


def _expected(kind: str) -> str:
    return {
        "color": "8-bit colour images",
        "depth": "depth images (16UC1 or 32FC1)",
        "camera": "sensor_msgs/CameraInfo",
    }[kind]


def _listed(types: Mapping[str, Any], limit: int = 12) -> str:
    names: Sequence[str] = sorted(types)
    listed = ", ".join(f"{name} ({types[name]})" for name in names[:limit])
    return (listed + (", ..." if len(names) > limit else "")) or "no topic"
