"""examples/ros2: the node in ROS 2 where that is installed, and without it on messages of rosbags."""

import importlib
import io
import sys
import types
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from PIL import Image
from processes import wait_until
from recording_files import COLOR, DEPTH, START, camera_info, image, table_frame
from refusals import assert_refused

import thor2_jax as thor2
from thor2_jax.client import Client, ServiceError
from thor2_jax.model.recognition import Recognition
from thor2_jax.recordings.detection_files import DETECTION_ARRAY, detection_types, ros_message
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
    """The module with the conversions; the node can be imported, too."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples" / "ros2"))
    yield importlib.import_module("frame_messages")
    for name in ("frame_messages", "detection_node"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("step", [1, 2])
def test_messages_become_detections(conversion: Any, step: int) -> None:
    client = LocalClient(step)
    color, depth = image(FRAME.color, "bgr8", START + 7), image((FRAME.depth / 1000).astype(np.float32), "32FC1")
    fields = conversion.detection_fields(client, color, depth, CAMERA)
    (sent,) = client.frames
    np.testing.assert_array_equal(sent.color, FRAME.color[..., ::-1])
    np.testing.assert_array_equal(sent.depth, FRAME.depth)
    assert sent.intrinsics.fx == 290 and sent.intrinsics.depth_scale == 1000
    stamp = {"sec": START // 10**9, "nanosec": 7}
    assert fields["header"] == {"stamp": stamp, "frame_id": "camera_color_optical_frame"}
    types = detection_types()
    content = types.serialize_cdr(ros_message(fields), DETECTION_ARRAY)
    message = types.deserialize_cdr(content, DETECTION_ARRAY)
    boxes = [(one.bbox.center.position.x, one.bbox.center.position.y, one.bbox.size_x) for one in message.detections]
    np.testing.assert_allclose(boxes, [(84.5, 114.5, 50), (214.5, 114.5, 70)], atol=2)
    assert [one.results[0].hypothesis.class_id for one in message.detections] == ["mug", "mug"]
    assert message.detections[0].results[0].pose.pose.position.z == pytest.approx(0.8, abs=0.01)


def test_a_service_that_does_not_segment(conversion: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    client = LocalClient()
    monkeypatch.setattr(client, "recognize_frame", lambda **_: ([], None))
    assert_refused("does not segment", conversion.detect, client, FRAME)


class Node:
    """Replacement of rclpy's Node with the methods that the node uses."""

    def __init__(self, name: str) -> None:
        self.parameters, self.callbacks, self.published, self.warnings = {}, {}, [], []
        self.declare_parameter, self.destroy_node = self.parameters.__setitem__, self.callbacks.clear

    def get_parameter(self, name: str) -> Any:
        return types.SimpleNamespace(value=self.parameters[name])

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        return types.SimpleNamespace(publish=lambda message: self.published.append((topic, message)))

    def create_subscription(self, kind: Any, topic: str, callback: Any, qos: Any) -> None:
        self.callbacks[topic] = callback

    def get_logger(self) -> Any:
        return types.SimpleNamespace(warning=lambda text, throttle_duration_sec: self.warnings.append(text))


@pytest.mark.parametrize(("color_topic", "fx"), [(COLOR, 290), ("/camera/color/image_rect_color", 280)])
def test_the_node_warns_and_goes_on(
    color_topic: str, fx: int, conversion: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without camera_info, and if the service fails, there is a warning; the next pair is published.

    The intrinsics of rectified images are P.
    """
    rclpy, filters, client, nodes = MagicMock(), MagicMock(), LocalClient(), []
    contents = {
        "rclpy": {name: getattr(rclpy, name) for name in ("init", "spin", "try_shutdown")},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": 10},
        "message_filters": {name: getattr(filters, name) for name in ("ApproximateTimeSynchronizer", "Subscriber")},
        "rosidl_runtime_py.set_message": {"set_message_fields": lambda message, fields: vars(message).update(fields)},
        "sensor_msgs.msg": {"CameraInfo": "CameraInfo", "Image": "Image"},
        "vision_msgs.msg": {"Detection2DArray": types.SimpleNamespace},
    }
    for name, values in contents.items():
        module = types.ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name, module)

    def spin(node: Any) -> None:
        nodes.append(node)
        topics = [call.args[2] for call in filters.Subscriber.call_args_list]
        assert topics == [color_topic, DEPTH]
        (publish,) = filters.ApproximateTimeSynchronizer.return_value.registerCallback.call_args.args
        pair = image(FRAME.color, "rgb8"), image(FRAME.depth, "16UC1")
        publish(*pair)
        camera = camera_info(FRAME.intrinsics, FRAME.depth.shape)
        camera.P[0] = 280
        node.callbacks["/camera/color/camera_info"](camera)
        with monkeypatch.context() as patch:
            patch.setattr(client, "recognize_frame", MagicMock(side_effect=ServiceError(503, None, "starting", 1.0)))
            publish(*pair)
        publish(*pair)
        raise KeyboardInterrupt

    rclpy.spin.side_effect = spin
    node_module = importlib.import_module("detection_node")
    monkeypatch.setattr(node_module, "Client", lambda *arguments: client)
    monkeypatch.setitem(node_module.PARAMETERS, "color_topic", color_topic)
    node_module.main()
    (node,) = nodes
    assert "camera_info" in node.warnings[0] and "503" in node.warnings[1] and len(node.warnings) == 2
    ((topic, message),) = node.published
    assert topic == "/thor2/detections" and message.header["stamp"]["sec"] == START // 10**9
    assert [one["results"][0]["hypothesis"]["class_id"] for one in message.detections] == ["mug", "mug"]
    assert client.frames[0].intrinsics.fx == fx and not node.callbacks
    rclpy.try_shutdown.assert_called_once_with()


@pytest.mark.slow
def test_the_node_publishes_detections_in_ros2(conversion: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed")
    from sensor_msgs.msg import CameraInfo, Image
    from vision_msgs.msg import Detection2DArray

    node_module = importlib.import_module("detection_node")
    monkeypatch.setattr(node_module, "Client", lambda *arguments: LocalClient())
    rclpy.init()
    node, camera, received = node_module.DetectionNode(), rclpy.create_node("camera"), []
    camera.create_subscription(Detection2DArray, "/thor2/detections", received.append, 1)
    height, width = FRAME.depth.shape
    info = CameraInfo(height=height, width=width, k=CAMERA.k, distortion_model="plumb_bob")
    sent = [(camera.create_publisher(CameraInfo, "/camera/color/camera_info", 10), info)]
    for topic, pixels, encoding in ((COLOR, FRAME.color, "rgb8"), (DEPTH, FRAME.depth, "16UC1")):
        message = Image(height=height, width=width, encoding=encoding, step=pixels[0].nbytes)
        message.header.stamp.sec, message.data = START // 10**9, np.frombuffer(pixels.tobytes(), np.uint8)
        sent.append((camera.create_publisher(Image, topic, 10), message))

    def send(seconds: float) -> None:
        for publisher, message in sent:
            publisher.publish(message)
        for _ in range(4):
            rclpy.spin_once(node, timeout_sec=0.1)
            rclpy.spin_once(camera, timeout_sec=0.1)

    wait_until(lambda: received, pause=send)
    assert received[0].header.stamp.sec == START // 10**9
    assert [one.results[0].hypothesis.class_id for one in received[0].detections] == ["mug", "mug"]
    node.destroy_node()
    rclpy.try_shutdown()
