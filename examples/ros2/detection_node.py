"""ROS 2 node that lets a THOR2 service recognize the images of a camera and publishes the detections; see README.md."""

import os

import rclpy
from frame_messages import detection_fields
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rosidl_runtime_py.set_message import set_message_fields
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray

from thor2_jax.client import Client, ServiceError
from thor2_jax.errors import InputError
from thor2_jax.recordings.messages import camera_of

PARAMETERS = {
    "url": "http://127.0.0.1:8080",
    "color_topic": "/camera/color/image_raw",
    "depth_topic": "/camera/aligned_depth_to_color/image_raw",
    "camera_topic": "/camera/color/camera_info",
    "max_gap": 0.03,  # seconds between colour and depth
    "timeout": 10.0,  # seconds for a request
}

WARNING_SECONDS = 5.0
"""Shortest time between two warnings."""


class DetectionNode(Node):
    """A node that sends pairs of colour and depth images to the service one at a time and publishes its answers."""

    def __init__(self) -> None:
        super().__init__("thor2")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        values = {name: self.get_parameter(name).value for name in PARAMETERS}
        self.client = Client(values["url"], os.environ.get("THOR2_TOKEN"), values["timeout"])
        self.camera: CameraInfo | None = None
        self.color_topic: str = values["color_topic"]
        self.publisher = self.create_publisher(Detection2DArray, "/thor2/detections", 1)
        self.create_subscription(CameraInfo, values["camera_topic"], self.set_camera, qos_profile_sensor_data)
        images = [
            Subscriber(self, Image, values[topic], qos_profile=qos_profile_sensor_data)
            for topic in ("color_topic", "depth_topic")
        ]
        # The queue has 2 entries, so of the images that arrive during a request only the newest are kept.
        self.synchronizer = ApproximateTimeSynchronizer(images, queue_size=2, slop=values["max_gap"])
        self.synchronizer.registerCallback(self.recognize)

    def set_camera(self, camera: CameraInfo) -> None:
        """Keep the intrinsics of the colour camera."""
        self.camera = camera

    def recognize(self, color: Image, depth: Image) -> None:
        """Recognize a pair of images and publish the detections; a failure is a warning, and the next pair follows."""
        if self.camera is None:
            self.get_logger().warning("no camera_info yet", throttle_duration_sec=WARNING_SECONDS)
            return
        try:
            camera = camera_of(self.camera, self.color_topic)
            fields = detection_fields(self.client, color, depth, camera)
        except (InputError, ServiceError, OSError) as error:
            self.get_logger().warning(f"no detections: {error}", throttle_duration_sec=WARNING_SECONDS)
            return
        message = Detection2DArray()
        set_message_fields(message, fields)
        self.publisher.publish(message)


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = DetectionNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
