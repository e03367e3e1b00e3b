"""A node that closes a gripper until contact and tightens while the object slips.

    python3 examples/ros2/hold.py --ros-args -p sensor:=main

Publishes the target width of the gripper, m, on ~/width (std_msgs/Float64). Slip detection needs the stage
`slip` in tactflow's pipeline.
"""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Bool, Float64

STEP = 0.0005
"""Closing distance per frame, m. Chosen by hand: 30 mm/s at 60 Hz."""
TIGHTEN = 0.0001
"""Closing distance per frame while the object slips, m. Chosen by hand."""


class Hold(Node):
    """Closes without contact, tightens during slip."""

    def __init__(self) -> None:
        super().__init__("hold")
        sensor = self.declare_parameter("sensor", "main").value
        self.width = self.declare_parameter("width", 0.08).value
        self.slipping = False
        self.command = self.create_publisher(Float64, "~/width", 10)
        # The bridge publishes with the QoS of sensor data; a reliable subscription would receive nothing.
        for topic, callback in (("touching", self.on_touching), ("slipping", self.on_slipping)):
            self.create_subscription(Bool, f"/{sensor}/tactflow/{topic}", callback, qos_profile_sensor_data)

    def on_slipping(self, message: Bool) -> None:
        """Arrives after `touching` of the same frame."""
        self.slipping = message.data

    def on_touching(self, message: Bool) -> None:
        """Publish the next width, every frame."""
        if not message.data:
            self.width -= STEP
        elif self.slipping:
            self.width -= TIGHTEN
        self.width = max(self.width, 0.0)
        self.command.publish(Float64(data=self.width))


def main() -> None:
    """Run until shutdown."""
    rclpy.init()
    try:
        rclpy.spin(Hold())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
