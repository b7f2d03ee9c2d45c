"""Conversions of the node between its subscriptions and its publisher: messages to a request, answers to fields.

The functions only read attributes of messages, so they also accept messages of rosbags.
"""

from typing import Any

import numpy as np

from thor2_jax.client import Client
from thor2_jax.errors import InputError
from thor2_jax.frames.frames import RGBDFrame, encode_image
from thor2_jax.model.recognition import Detection, detections_of
from thor2_jax.recordings.messages import color_image, depth_image, detection_array, stamp_of

MILLIMETRES = 1000.0
"""Depth units per metre of the depth images for the service."""


def frame_of(color: Any, depth: Any, camera: Any) -> RGBDFrame:
    """Return the frame of a colour image, the depth image that is aligned to it, and their CameraInfo or intrinsics.

    Raises:
        InputError: an encoding is not supported, or the images have different sizes.
    """
    return RGBDFrame(color_image(color), depth_image(depth), None, camera)


def detect(client: Client, frame: RGBDFrame) -> list[Detection]:
    """Let the service segment and recognize a frame.

    Raises:
        InputError: the service is too old to segment frames.
        ServiceError: the service refuses the frame.
        OSError: the service cannot be reached.
    """
    millimetres = np.clip(np.round(frame.depth_m * MILLIMETRES), 0, 2**16 - 1).astype(np.uint16)
    camera = frame.intrinsics
    recognitions, labels = client.recognize_frame(
        color=encode_image(frame.color, compress_level=1),
        depth=encode_image(millimetres, compress_level=1),
        intrinsics={
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
            "depth_scale": MILLIMETRES,
            "distortion": list(camera.distortion),
        },
    )
    if labels is None:
        raise InputError("the service does not segment frames; update it")
    # The service halves the size of large label images.
    height, width = frame.depth.shape
    factor = -(-height // len(labels))
    labels = labels.repeat(factor, axis=0).repeat(factor, axis=1)[:height, :width]
    labelled = RGBDFrame(frame.color, frame.depth, labels, camera)
    return detections_of(labelled, [one for one in recognitions if one.label in labelled.instances])


def detection_fields(client: Client, color: Any, depth: Any, camera: Any) -> dict[str, Any]:
    """Return the fields of the Detection2DArray for a pair of images; exceptions as `frame_of` and `detect`."""
    detections = detect(client, frame_of(color, depth, camera))
    return detection_array(detections, stamp=stamp_of(color), frame_id=color.header.frame_id)
