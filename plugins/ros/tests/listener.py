"""Another program in ROS 2: tells what it receives, line by line, and does what its input says.

Runs with the Python of `.venv-ros`, which knows rclpy and nothing of tactflow.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from array import array
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonStamped, PoseStamped, Vector3Stamped, WrenchStamped
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Bool, Float64
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

NODE = "/left/tactflow"
TELLING = threading.Lock()
TOPICS = {
    "touching": Bool,
    "slipping": Bool,
    "contact": PolygonStamped,
    "contact_pixels": PolygonStamped,
    "contact_pose": PoseStamped,
    "contact_pose_pixels": PoseStamped,
    "slip": PoseStamped,
    "slip_pixels": PoseStamped,
    "flow": Vector3Stamped,
    "flow_pixels": Vector3Stamped,
    "markers": PointCloud2,
    "markers_pixels": PointCloud2,
    "wrench": WrenchStamped,
    "object_pose": PoseStamped,
    "depth": Image,
    "surface": PointCloud2,
    "image/compressed": CompressedImage,
    "/tf": TFMessage,
    "/diagnostics": DiagnosticArray,
    "/clock": Clock,
    "/hold/width": Float64,
}


def plain(value: Any) -> Any:
    """A message as JSON can tell it."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, bytes | array | np.ndarray):
        return list(value)
    return value


def tell(**what: Any) -> None:
    with TELLING:
        print(json.dumps(what), flush=True)


def configure(overrides: dict[str, Any]) -> None:
    """Start a bridge with these parameters in this process; tell whether it would, and how it is then."""
    from tactflow_ros.bridge import Bridge

    node = Bridge(parameter_overrides=[Parameter(name, value=value) for name, value in overrides.items()])
    configured = node.trigger_configure()
    activated = node.trigger_activate() if configured.name == "SUCCESS" else None
    condition = service = None
    if activated is not None and activated.name == "SUCCESS":
        while (reason := node._condition(node._link)) is None:
            time.sleep(0.02)
        condition = reason[1]
        service = node._take_reference(Trigger.Request(), Trigger.Response()).message
    node.disconnect()
    node.destroy_node()
    names = [state and state.name for state in (configured, activated)]
    tell(configured=names[0], activated=names[1], condition=condition, service=service)


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("listener")
    kept: list[Any] = []
    for topic, kind in TOPICS.items():
        name = topic if topic.startswith("/") else f"{NODE}/{topic}"
        # What is sent to be received in full is asked for in full.
        qos = 10 if topic in ("/diagnostics", "/hold/width", "/tf") else qos_profile_sensor_data

        def receive(message: Any, topic: str = topic) -> None:
            tell(topic=topic, at=time.monotonic_ns(), message=plain(message))

        if topic in sys.argv[1:] or len(sys.argv) == 1:
            kept.append(node.create_subscription(kind, name, receive, qos))
    service = node.create_client(Trigger, f"{NODE}/take_reference")
    threading.Thread(target=rclpy.spin, args=(node,), daemon=True).start()
    tell(ready=True)
    for line in sys.stdin:
        order = json.loads(line)
        if order["do"] == "call":
            service.wait_for_service(60)
            answer = service.call(Trigger.Request())
            tell(success=answer.success, said=answer.message)
        elif order["do"] == "wait for":
            while not node.count_publishers(f"{NODE}/{order['topic']}"):
                time.sleep(0.02)
            tell(found=order["topic"])
        elif order["do"] == "configure":
            configure(order["parameters"])
    rclpy.shutdown()


main()
