"""examples/ros2: the node in ROS 2 where that is installed, and without it on messages of rosbags."""

import collections
import functools
import importlib
import io
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import encode_image
from PIL import Image
from processes import HANG
from recording_files import START, camera_info, compressed, image, table_frame
from rosbags.interfaces import Nodetype

import thor2_jax as thor2
from thor2_jax.client import Client, ServiceError
from thor2_jax.errors import InputError
from thor2_jax.model.recognition import Recognition
from thor2_jax.recordings.bag_writer import DETECTION_ARRAY, detection_types, ros_message
from thor2_jax.recordings.messages import stamp_of
from thor2_jax.segmentation.segmenters import segment

FRAME = table_frame()
CAMERA = camera_info(FRAME.intrinsics, FRAME.depth.shape)


class LocalClient(Client):
    """A client whose service segments in this process and names every object `mug`."""

    def __init__(self, step: int = 1) -> None:
        self.step, self.frames = step, []

    def recognize_frame(self, *, color: Any, depth: Any, labels: Any = None, intrinsics: Any) -> Any:
        pixels = [np.asarray(Image.open(io.BytesIO(content))) for content in (color, depth)]
        self.frames.append(thor2.RGBDFrame(*pixels, None, intrinsics))
        found = segment(self.frames[-1])
        answers = [Recognition(int(label), "mug", 0.9) for label in np.unique(found) if label]
        return answers, found[:: self.step, :: self.step]


@pytest.fixture
def conversion(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples" / "ros2"))
    yield importlib.import_module("frame_messages")
    sys.modules.pop("frame_messages", None)


@pytest.mark.parametrize("step", [1, 2])
def test_messages_become_detections(conversion: Any, step: int) -> None:
    client = LocalClient(step)
    color, depth = image(FRAME.color, "bgr8", START + 7), image((FRAME.depth / 1000).astype(np.float32), "32FC1")
    fields = conversion.detection_fields(client, color, depth, CAMERA)
    (sent,) = client.frames
    np.testing.assert_array_equal(sent.color, FRAME.color[..., ::-1])
    np.testing.assert_array_equal(sent.depth, FRAME.depth)
    assert sent.intrinsics.fx == 290 and sent.intrinsics.depth_scale == 1000
    assert fields["header"] == {
        "stamp": {"sec": START // 10**9, "nanosec": 7},
        "frame_id": "camera_color_optical_frame",
    }
    types = detection_types()
    message = types.deserialize_cdr(
        types.serialize_cdr(ros_message(types, DETECTION_ARRAY, fields), DETECTION_ARRAY), DETECTION_ARRAY
    )
    boxes = [(one.bbox.center.position.x, one.bbox.center.position.y, one.bbox.size_x) for one in message.detections]
    np.testing.assert_allclose(boxes, [(84.5, 114.5, 50), (214.5, 114.5, 70)], atol=2)
    assert [one.results[0].hypothesis.class_id for one in message.detections] == ["mug", "mug"]
    assert message.detections[0].results[0].pose.pose.position.z == pytest.approx(0.8, abs=0.01)


def test_compressed_images_and_refused_ones(conversion: Any) -> None:
    jpeg = compressed(encode_image(FRAME.color, "JPEG"), "jpeg")
    frame = conversion.frame_of(jpeg, image(FRAME.depth, "16UC1"), CAMERA)
    assert frame.color.shape == (240, 320, 3)
    with pytest.raises(InputError, match="depth has shape"):
        conversion.frame_of(jpeg, image(FRAME.depth[::2, ::2], "16UC1"), CAMERA)


def test_a_service_that_does_not_segment(conversion: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    client = LocalClient()
    monkeypatch.setattr(client, "recognize_frame", lambda **_: ([], None))
    with pytest.raises(InputError, match="does not segment"):
        conversion.detect(client, FRAME)


class Bus:
    """Stands for ROS 2 in one process: what the node and this test use of rclpy and message_filters.

    Messages have the classes of rosbags and pass through their serialization, as between two processes.
    """

    def __init__(self) -> None:
        self.types, self.warnings = detection_types(), []
        self.callbacks: dict[str, list[Any]] = {}
        self.queue: collections.deque[tuple[str, str, bytes]] = collections.deque()

    def kind(self, name: str) -> type:
        """Return a class whose instances are default messages, like those of rosidl."""
        types = self.types

        def default(description: Any) -> Any:
            node, details = description
            if node == Nodetype.NAME:
                return {field: default(inner) for field, inner in types.fielddefs[details][1]}
            if node == Nodetype.BASE:
                return "" if details[0] == "string" else False if details[0] == "bool" else 0
            (element, base), count = details
            return [] if element == Nodetype.NAME else np.zeros(count or 0, base[0])

        fields = default((Nodetype.NAME, name))
        return type(name, (), {"__new__": lambda _: ros_message(types, name, fields), "name": name})

    def publish(self, topic: str, message: Any, kind: str) -> None:
        self.queue.append((topic, kind, bytes(self.types.serialize_cdr(message, kind))))

    def spin_once(self, node: Any, timeout_sec: float | None = None) -> None:
        if self.queue:
            topic, kind, content = self.queue.popleft()
            for callback in self.callbacks.get(topic, []):
                callback(self.types.deserialize_cdr(content, kind))

    def spin(self, node: Any) -> None:
        while self.queue:
            self.spin_once(node)
        raise KeyboardInterrupt

    def modules(self) -> dict[str, dict[str, Any]]:
        bus = self

        class Node:
            def __init__(self, name: str) -> None:
                self.parameters: dict[str, Any] = {}

            def declare_parameter(self, name: str, default: Any) -> None:
                self.parameters[name] = default

            def get_parameter(self, name: str) -> Any:
                return types.SimpleNamespace(value=self.parameters[name])

            def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
                return types.SimpleNamespace(publish=lambda message: bus.publish(topic, message, kind.name))

            def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
                bus.callbacks.setdefault(topic, []).append(callback)

            def get_logger(self) -> Any:
                return types.SimpleNamespace(warning=lambda text, throttle_duration_sec: bus.warnings.append(text))

            def destroy_node(self) -> None:
                bus.callbacks.clear()

        class Subscriber:
            def __init__(self, node: Node, kind: Any, topic: str, qos_profile: Any) -> None:
                self.subscribe = lambda callback: node.create_subscription(kind, topic, callback, qos_profile)

        class Synchronizer:
            def __init__(self, subscribers: list[Subscriber], queue_size: int, slop: float) -> None:
                self.latest, self.slop = [None] * len(subscribers), slop
                for number, subscriber in enumerate(subscribers):
                    subscriber.subscribe(functools.partial(self.add, number))

            def registerCallback(self, callback: Any) -> None:  # noqa: N802
                self.callback = callback

            def add(self, number: int, message: Any) -> None:
                self.latest[number] = message
                if None not in self.latest and abs(np.diff([stamp_of(one) for one in self.latest])) < 1e9 * self.slop:
                    self.callback(*self.latest)

        def set_fields(message: Any, fields: Any) -> None:
            vars(message).update(vars(ros_message(bus.types, message.__msgtype__, fields)))

        nothing = {"init": lambda: None, "try_shutdown": lambda: None}
        images = {name: self.kind(f"sensor_msgs/msg/{name}") for name in ("CameraInfo", "Image")}
        return {
            "rclpy": {**nothing, "spin": self.spin, "spin_once": self.spin_once, "create_node": Node},
            "rclpy.node": {"Node": Node},
            "rclpy.qos": {"qos_profile_sensor_data": 10},
            "message_filters": {"ApproximateTimeSynchronizer": Synchronizer, "Subscriber": Subscriber},
            "rosidl_runtime_py": {},
            "rosidl_runtime_py.set_message": {"set_message_fields": set_fields},
            "sensor_msgs": {},
            "sensor_msgs.msg": images,
            "vision_msgs": {},
            "vision_msgs.msg": {"Detection2DArray": self.kind(DETECTION_ARRAY)},
        }


@pytest.fixture(params=["stand-ins", pytest.param("rclpy", marks=pytest.mark.slow)])
def ros(request: pytest.FixtureRequest, conversion: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """ROS 2 where it is installed, and stand-ins for it: the module of the node and the bus, None for ROS 2."""
    bus = Bus() if request.param == "stand-ins" else None
    if bus is None:
        pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    else:
        for name, contents in bus.modules().items():
            module = types.ModuleType(name)
            vars(module).update(contents)
            monkeypatch.setitem(sys.modules, name, module)
    node = importlib.import_module("detection_node")
    client = LocalClient()
    monkeypatch.setattr(node, "Client", lambda *arguments: client)
    yield types.SimpleNamespace(node=node, bus=bus, client=client)
    sys.modules.pop("detection_node", None)


def camera_publishers(camera: Any) -> Any:
    """Return functions that publish the intrinsics, and a pair of images, as the driver of a camera does."""
    from sensor_msgs.msg import CameraInfo, Image

    height, width = FRAME.depth.shape
    info, (color, depth) = CameraInfo(), (Image(), Image())
    info.height, info.width, info.k, info.distortion_model = height, width, CAMERA.k, "plumb_bob"
    for message, pixels, encoding in ((color, FRAME.color, "rgb8"), (depth, FRAME.depth, "16UC1")):
        message.header.stamp.sec = START // 10**9
        message.height, message.width, message.encoding = height, width, encoding
        message.step, message.data = pixels[0].nbytes, np.frombuffer(pixels.tobytes(), np.uint8)
    topics = {"/camera/color/image_raw": color, "/camera/aligned_depth_to_color/image_raw": depth}
    images = [(camera.create_publisher(Image, topic, 10), message) for topic, message in topics.items()]
    publisher = camera.create_publisher(CameraInfo, "/camera/color/camera_info", 10)
    return lambda: publisher.publish(info), lambda: [one.publish(message) for one, message in images]


def test_the_node_publishes_detections(ros: Any) -> None:
    import rclpy
    from vision_msgs.msg import Detection2DArray

    rclpy.init()
    node, camera, received = ros.node.DetectionNode(), rclpy.create_node("camera"), []
    camera.create_subscription(Detection2DArray, "/thor2/detections", received.append, 1)
    publish_camera, publish_images = camera_publishers(camera)
    start = time.monotonic()
    while not received:
        assert time.monotonic() - start < HANG
        publish_camera()
        publish_images()
        for _ in range(4):
            rclpy.spin_once(node, timeout_sec=0.1)
            rclpy.spin_once(camera, timeout_sec=0.1)
    assert received[0].header.stamp.sec == START // 10**9
    assert [one.results[0].hypothesis.class_id for one in received[0].detections] == ["mug", "mug"]
    assert ros.client.frames[0].intrinsics.fx == 290
    node.destroy_node()
    rclpy.try_shutdown()


@pytest.mark.parametrize("ros", ["stand-ins"], indirect=True)
def test_main_warns_and_goes_on(ros: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without camera_info, and if the service fails, there is a warning, and the next pair follows."""
    import rclpy

    publish_camera, publish_images = camera_publishers(rclpy.create_node("camera"))
    answers = iter([ServiceError(503, None, "starting", 1.0), None])
    recognize = ros.client.recognize_frame

    def fail_first(**files: Any) -> Any:
        error = next(answers)
        if error is not None:
            raise error
        return recognize(**files)

    monkeypatch.setattr(ros.client, "recognize_frame", fail_first)
    publish_images()
    publish_camera()
    publish_images()
    ros.node.main()
    assert "camera_info" in ros.bus.warnings[0] and "503" in ros.bus.warnings[-1]
    assert ros.client.frames and not ros.bus.callbacks
