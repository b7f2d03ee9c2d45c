"""RealSense cameras: the library's own software device, and sources that fail."""

from typing import Any

import numpy as np
import pytest
from processes import HANG
from refusals import assert_refused

from thor2_jax.errors import InputError
from thor2_jax.recordings.realsense import RealSenseCamera

WIDTH, HEIGHT = 64, 48


@pytest.fixture
def rs() -> Any:
    return pytest.importorskip(
        "pyrealsense2", reason="pyrealsense2, or the system library libusb-1.0, is not installed", exc_type=ImportError
    )


class SoftwareCamera:
    """A software device with a colour and a depth sensor, whose images a test gives it."""

    def __init__(self, rs: Any) -> None:
        self.rs, self.device, self.queue = rs, rs.software_device(), rs.syncer(20)
        self.wait_for_frames = self.queue.wait_for_frames
        intrinsics = rs.intrinsics()
        camera = {"width": WIDTH, "height": HEIGHT, "fx": 60.0, "fy": 61.0, "ppx": 32.0, "ppy": 24.0}
        for name, value in {**camera, "model": rs.distortion.brown_conrady, "coeffs": [0.01, 0, 0, 0, 0]}.items():
            setattr(intrinsics, name, value)
        self.sensors = {}
        for uid, (name, stream, kind, size) in enumerate(
            [("Depth", rs.stream.depth, rs.format.z16, 2), ("Color", rs.stream.color, rs.format.rgb8, 3)]
        ):
            video = rs.video_stream()
            for field, value in dict(type=stream, index=0, uid=uid, width=WIDTH, height=HEIGHT, fps=30).items():
                setattr(video, field, value)
            video.bpp, video.fmt, video.intrinsics = size, kind, intrinsics
            sensor = self.device.add_sensor(name)
            self.sensors[name] = sensor, sensor.add_video_stream(video), size
        self.sensors["Depth"][0].add_read_only_option(rs.option.depth_units, 0.00025)
        identity = rs.extrinsics()
        identity.rotation, identity.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
        self.sensors["Depth"][1].register_extrinsics_to(self.sensors["Color"][1], identity)
        self.device.create_matcher(rs.matchers.default)
        for sensor, profile, _ in self.sensors.values():
            sensor.open(profile)
            sensor.start(self.queue)

    def give(self, number: int, **images: np.ndarray) -> None:
        for name, (sensor, profile, size) in self.sensors.items():
            frame = self.rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = images[name].ravel().view(np.uint8), WIDTH * size, size
            frame.timestamp, frame.domain = 1000.0 + 33 * number, self.rs.timestamp_domain.system_time
            frame.frame_number, frame.profile = number, profile.as_video_stream_profile()
            if name == "Depth":
                frame.depth_units = 0.00025
            sensor.on_video_frame(frame)


def test_frames_of_the_software_device(rs: Any) -> None:
    rng, camera = np.random.default_rng(0), SoftwareCamera(rs)
    colors = [rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(8)]
    for k, color in enumerate(colors):
        camera.give(k, Depth=np.full((HEIGHT, WIDTH), 4000 + k, np.uint16), Color=color)
    with RealSenseCamera(camera, timeout=HANG) as opened:
        recorded = next(opened.frames())
        frame = recorded.read()
        number = round((recorded.stamp / 1e6 - 1000) / 33)
        np.testing.assert_array_equal(frame.color, colors[number])
        assert frame.labels is None and recorded.gap == 0 and recorded.name == f"1.{33 * number:03d}000000"
        inner = frame.depth[5:-5, 5:-5]
        assert (inner == 4000 + number).all() and frame.depth_m[24, 32] == pytest.approx(1 + number / 4000)
        camera_of = frame.intrinsics
        assert (camera_of.fx, camera_of.fy, camera_of.cx, camera_of.cy) == (60, 61, 32, 24)
        assert camera_of.depth_scale == 4000 and camera_of.distortion[0] == pytest.approx(0.01)
    with RealSenseCamera(camera, timeout=0.1) as opened, pytest.raises(InputError, match="unplugged"):
        list(opened.frames())  # until there are no more images
    for sensor, _, _ in camera.sensors.values():
        sensor.stop()
        sensor.close()


def test_no_camera_is_connected(rs: Any) -> None:
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense camera is connected")
    assert_refused("no camera can be started", RealSenseCamera().__enter__)
