"""Write a sample recording: two seconds of built-in objects on a table, as a moving depth camera would see them.

python -m training.rendering.sample_recording table.mcap
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from thor2_jax.errors import InputError, reason_of
from thor2_jax.frames.frames import Intrinsics, encode_image
from thor2_jax.recordings.detection_files import COMPRESSED_IMAGE, MessageBag
from thor2_jax.recordings.messages import ros_time
from training.objects.builtin_objects import builtin_objects
from training.rendering.camera import Camera
from training.rendering.scenes import compose_views

__all__ = ["write_sample_recording"]

CAMERA = Camera.from_field_of_view(320, 240, 57)
FRAMES, HERTZ, ARC = 16, 8, 0.1
"""Number of frames, frame rate, and angle in radians by which the camera moves around the table."""

START = 1_700_000_000 * 10**9
FRAME_ID = "camera_color_optical_frame"
COLOR, DEPTH = "/camera/color/image_raw/compressed", "/camera/aligned_depth_to_color/image_raw/compressedDepth"
INFO = "/camera/color/camera_info"


def write_sample_recording(path: str | Path) -> None:
    """Write the recording: colour as JPEG, aligned depth as `compressedDepth`, and `camera_info`.

    Args:
        path: MCAP file (.mcap) or directory of a ROS 2 bag that does not exist; 0.45 MB.

    Raises:
        InputError: as `MessageBag`.
        OSError: the recording cannot be written.
    """
    topics = {COLOR: COMPRESSED_IMAGE, DEPTH: COMPRESSED_IMAGE, INFO: "sensor_msgs/msg/CameraInfo"}
    with MessageBag(path, topics) as bag:
        views = compose_views(
            builtin_objects(), np.random.default_rng(8), n_objects=4, n_views=FRAMES, camera=CAMERA, arc=ARC,
            clutter=0.0, noise=0.03, light=0.0, level=True,
        )  # fmt: skip
        for number, (scene, _) in enumerate(views):
            stamp = START + number * 10**9 // HERTZ
            header = {"header": {"stamp": ros_time(stamp), "frame_id": FRAME_ID}}
            color = np.frombuffer(encode_image(scene.frame.color, "JPEG", quality=93), np.uint8)
            jpeg = {"format": "rgb8; jpeg compressed bgr8", "data": color}
            # compressed_depth_image_transport puts 12 bytes before the PNG.
            png = np.frombuffer(bytes(12) + encode_image(scene.frame.depth), np.uint8)
            bag.write_message(INFO, {**header, **_camera_info(scene.frame.intrinsics)}, stamp)
            bag.write_message(COLOR, {**header, **jpeg}, stamp)
            bag.write_message(DEPTH, {**header, "format": "16UC1; compressedDepth png", "data": png}, stamp)


def _camera_info(camera: Intrinsics) -> dict[str, Any]:
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float64)
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return {
        "height": CAMERA.height, "width": CAMERA.width, "distortion_model": "plumb_bob", "d": np.zeros(5),
        "k": matrix.ravel(), "r": np.eye(3).ravel(), "p": np.pad(matrix, ((0, 0), (0, 1))).ravel(),
        "binning_x": 0, "binning_y": 0, "roi": region,
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m training.rendering.sample_recording")
    parser.add_argument("path", help="MCAP file (.mcap) or directory of a ROS 2 bag that does not exist")
    try:
        write_sample_recording(parser.parse_args().path)
    except (InputError, OSError) as error:
        parser.error(reason_of(error))
