"""examples/ros2 without ROS: its pure functions on messages of rosbags, and its callbacks with stand-ins for rclpy."""

import importlib
import io
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recording_files import START, camera_info, compressed, encoded, image, table_frame

import thor2_jax as thor2
from thor2_jax.client import Client, ServiceError
from thor2_jax.errors import InputError
from thor2_jax.recognition.answers import Recognition
from thor2_jax.recordings.bag_writer import DETECTION_ARRAY, detection_types, ros_message
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
    jpeg = compressed(encoded(FRAME.color, "JPEG"), "jpeg")
    frame = conversion.frame_of(jpeg, image(FRAME.depth, "16UC1"), CAMERA)
    assert frame.color.shape == (240, 320, 3)
    with pytest.raises(InputError, match="depth has shape"):
        conversion.frame_of(jpeg, image(FRAME.depth[::2, ::2], "16UC1"), CAMERA)


def test_a_service_that_does_not_segment(conversion: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    client = LocalClient()
    monkeypatch.setattr(client, "recognize_frame", lambda **_: ([], None))
    with pytest.raises(InputError, match="does not segment"):
        conversion.detect(client, FRAME)


class Anything:
    """Stands for a class of ROS; it takes all calls and records what is published and warned of."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.published: list[Any] = []
        self.warnings: list[str] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: self

    def get_parameter(self, name: str) -> Any:
        return types.SimpleNamespace(value=1.0 if name in ("max_gap", "timeout") else "/x")

    def publish(self, message: Any) -> None:
        self.published.append(message)

    def warning(self, text: str, **_: Any) -> None:
        self.warnings.append(text)


@pytest.fixture
def node(conversion: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    made = {
        "rclpy": {},
        "rclpy.node": {"Node": Anything},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "message_filters": {"ApproximateTimeSynchronizer": Anything, "Subscriber": Anything},
        "rosidl_runtime_py": {},
        "rosidl_runtime_py.set_message": {"set_message_fields": lambda message, fields: vars(message).update(fields)},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CameraInfo": object, "Image": object},
        "vision_msgs": {},
        "vision_msgs.msg": {"Detection2DArray": types.SimpleNamespace},
    }
    for name, contents in made.items():
        module = types.ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    made_node = importlib.import_module("detection_node").DetectionNode()
    yield made_node
    sys.modules.pop("detection_node", None)


def test_callbacks_of_the_node(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    node.client = LocalClient()
    color, depth = image(FRAME.color, "rgb8"), image(FRAME.depth, "16UC1")
    node.recognize(color, depth)
    assert node.published == [] and "camera_info" in node.warnings[-1]
    node.set_camera(CAMERA)
    node.recognize(color, depth)
    (message,) = node.published
    assert len(message.detections) == 2

    def fail(**_: Any) -> Any:
        raise ServiceError(503, None, "starting", 1.0)

    monkeypatch.setattr(node.client, "recognize_frame", fail)
    node.recognize(color, depth)
    assert len(node.published) == 1 and "503" in node.warnings[-1]
