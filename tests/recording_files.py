"""Recordings that tests write: ROS 1 bags, ROS 2 bags and MCAP files of RGB-D frames."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

import thor2_jax as thor2
from thor2_jax.frames.frames import encode_image

COLOR = "/camera/color/image_raw"
DEPTH = "/camera/aligned_depth_to_color/image_raw"
CAMERA = "/camera/color/camera_info"
START = 1_700_000_000 * 10**9
PERIOD = 33_333_333


def header(stamp: int, frame_id: str = "camera_color_optical_frame") -> Any:
    """Return a Header of both versions of ROS; the writers take any object that has the fields of a message."""
    time = SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9)
    return SimpleNamespace(seq=0, stamp=time, frame_id=frame_id)


def image(pixels: np.ndarray, encoding: str, stamp: int = START, padding: int = 0, **more: Any) -> Any:
    """Return an Image with `padding` unused bytes behind each row."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    data = np.pad(rows, ((0, 0), (0, padding)))
    return SimpleNamespace(
        __msgtype__="sensor_msgs/msg/Image",
        header=header(stamp, **more),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(pixels.dtype.byteorder == ">"),
        step=data.shape[1],
        data=data.ravel(),
    )


def compressed(content: bytes, described: str, stamp: int = START) -> Any:
    data, kind = np.frombuffer(content, np.uint8), "sensor_msgs/msg/CompressedImage"
    return SimpleNamespace(__msgtype__=kind, header=header(stamp), format=described, data=data)


def compressed_depth(depth: np.ndarray, stamp: int = START) -> Any:
    """Return depth as compressed_depth_image_transport writes it: a header of 12 bytes, then a PNG."""
    return compressed(bytes(12) + encode_image(depth), "16UC1; compressedDepth png", stamp)


def camera_info(camera: thor2.Intrinsics, size: tuple[int, int], stamp: int = START) -> Any:
    """Return a CameraInfo, whose arrays have the names of ROS 1 and of ROS 2."""
    matrix = np.array([[camera.fx, 0, camera.cx, 0], [0, camera.fy, camera.cy, 0], [0, 0, 1.0, 0]])
    arrays = {"d": np.zeros(5), "k": matrix[:, :3].ravel(), "r": np.eye(3).ravel(), "p": matrix.ravel()}
    return SimpleNamespace(
        __msgtype__="sensor_msgs/msg/CameraInfo",
        header=header(stamp),
        height=size[0],
        width=size[1],
        distortion_model="plumb_bob",
        **arrays,
        **{name.upper(): value for name, value in arrays.items()},
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


@contextlib.contextmanager
def bag_writer(path: Path, compression: str = "") -> Iterator[Any]:
    """Yield a function (topic, message, time of arrival) that writes to a bag of the kind that the suffix says.

    The compression is a format of ROS 1 (bz2, lz4) or a mode of ROS 2 (message, storage).
    """
    ros = 1 if path.suffix == ".bag" else 2
    types, connections = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE), {}
    folder = path.with_suffix(".folder") if path.suffix == ".mcap" else path
    plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
    unopened: Any = Writer1(path) if ros == 1 else Writer2(folder, version=8, storage_plugin=plugin)
    if compression and ros == 1:
        unopened.set_compression(Writer1.CompressionFormat[compression.upper()])
    elif compression:
        unopened.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with unopened as writer:

        def write(topic: str, message: Any, arrival: int) -> None:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            serialize = types.serialize_ros1 if ros == 1 else types.serialize_cdr
            writer.write(connections[topic], arrival, serialize(message, kind))

        yield write
    if path.suffix == ".mcap":
        next(folder.glob("*.mcap")).rename(path)


def write_images(
    write: Any, frame: thor2.RGBDFrame, arrival: int, stamp: int, gap: int = 0, camera: bool = True, **color: Any
) -> None:
    """Write the messages of one frame, uncompressed, whose depth is taken `gap` nanoseconds after colour.

    `color` has further fields of the colour image.
    """
    write(COLOR, image(frame.color, "rgb8", stamp, **color), arrival)
    write(DEPTH, image(frame.depth, "16UC1", stamp + gap), arrival + gap)
    if camera:
        write(CAMERA, camera_info(frame.intrinsics, frame.depth.shape, stamp), arrival)


def write_recording(
    path: Path,
    frames: Sequence[thor2.RGBDFrame],
    *,
    is_compressed: bool = False,
    gap: int = 4_000_000,
    compression: str = "",
) -> Path:
    """Write a recording of frames at 30 Hz, whose depth is taken `gap` nanoseconds after colour."""
    with bag_writer(path, compression) as write:
        for number, frame in enumerate(frames):
            stamp = START + number * PERIOD
            if is_compressed:
                jpeg = encode_image(frame.color, "JPEG", quality=95)
                write(f"{COLOR}/compressed", compressed(jpeg, "rgb8; jpeg compressed bgr8", stamp), stamp)
                write(f"{DEPTH}/compressedDepth", compressed_depth(frame.depth, stamp + gap), stamp + gap)
                write(CAMERA, camera_info(frame.intrinsics, frame.depth.shape, stamp), stamp)
            else:
                write_images(write, frame, stamp, stamp, gap)
    return path


def table_frame(shift: int = 0) -> thor2.RGBDFrame:
    """Return a frame without labels: two boxes on a table that is seen from straight above."""
    color, depth = np.full((240, 320, 3), (150, 120, 90), np.uint8), np.full((240, 320), 900, np.uint16)
    for left, right, shade in ((60, 110, (190, 30, 40)), (180, 250, (30, 60, 190))):
        color[80:150, left + shift : right + shift] = shade
        depth[80:150, left + shift : right + shift] = 800
    return thor2.RGBDFrame(color, depth, None, thor2.Intrinsics(290.0, 290.0, 160.0, 120.0))
