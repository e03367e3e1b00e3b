"""The node that publishes the results of a running tactflow as topics.

A lifecycle node for one sensor. `configure` validates the parameters and creates the topics, `activate`
connects. The receiving thread publishes the messages; the executor handles only the service and a timer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PolygonStamped, PoseStamped, Vector3Stamped, WrenchStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock as Steady
from rclpy.clock import ClockType
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, State, TransitionCallbackReturn
from rclpy.logging import get_logger
from rclpy.qos import QoSDurabilityPolicy, QoSProfile, QoSReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CompressedImage, Image, PointCloud2
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from tactflow_ros import messages
from tactflow_ros.health import Health, diagnostics
from tactflow_ros.link import Link, LinkError, send_command
from tactflow_ros.surface import surface

try:
    from tf2_msgs.msg import TFMessage
except ModuleNotFoundError:
    # Part of geometry2, which the smallest installations of ROS 2 lack.
    TFMessage = None

QUEUE_DEPTH = 10
"""Queue length of a topic."""
ANSWER_SECONDS = 2.0
"""Timeout of the service, s. Chosen by hand."""
TF_QOS = QoSProfile(depth=100, reliability=QoSReliabilityPolicy.RELIABLE)
"""Quality of service of /tf, as of tf2's own broadcaster."""

PARAMETERS: dict[str, tuple[Any, str]] = {
    "endpoint": ("tcp://127.0.0.1:5556", "address of results: sinks.zmq.endpoint"),
    "sensor": ("main", "name of the sensor in tactflow"),
    "control": ("", "sinks.zmq.control, for the service ~/take_reference; empty disables it"),
    "keys": ("", "folder of the subscriber, from tactflow keys new; empty for no keys"),
    "frame_id": ("tactile_optical_frame", "frame of the picture: x right, y down, z out of the gel"),
    "object_frame_id": (
        "tactile_object",
        "frame of the object on /tf while it is tracked; empty: none",
    ),
    "surface_step": (2, "every how many pixels the topic surface has a point"),
    "reliability": ("best_effort", "of the topics: best_effort or reliable"),
    "timeout": (2.0, "time without a message before /diagnostics reports it, s"),
    "publish_clock": (False, "also publish /clock, from the capture times of a recording"),
    "autostart": (True, "configure and activate automatically"),
}
"""Parameter -> default, description."""

Maker = Callable[[messages.Message, Any, messages.Unit], Any]

GEOMETRY: dict[str, tuple[type, Maker]] = {
    "contact": (PolygonStamped, messages.polygon),
    "contact_pose": (PoseStamped, messages.pose),
    "flow": (Vector3Stamped, messages.flow),
    "slip": (PoseStamped, messages.slip),
    "markers": (PointCloud2, messages.markers),
}
"""Topic -> type and converter; published in metres and, as `NAME_pixels`, in pixels."""
UNITLESS = {
    "touching": Bool,
    "slipping": Bool,
    "wrench": WrenchStamped,
    "object_pose": PoseStamped,
    "depth": Image,
    "surface": PointCloud2,
    "image/compressed": CompressedImage,
}
"""Topic -> type, for topics in a single unit."""
ON_DEMAND = {
    "image/compressed": "tactflow_picture",
    "depth": "tactflow_depth",
    "surface": "tactflow_depth",
}
"""Topic -> message that tactflow sends only on subscription."""


class Bridge(LifecycleNode):
    """Topics, the service and the diagnostics of one sensor."""

    def __init__(self, **options: Any) -> None:
        super().__init__("tactflow", **options)
        for name, (default, meaning) in PARAMETERS.items():
            self.declare_parameter(name, default, ParameterDescriptor(description=meaning))
        self._topics: dict[str, Any] = {}
        self._link: Link | None = None
        self._health = Health()
        self._unit = messages.PIXELS
        self._run: dict[str, Any] = {}
        self._warned_replay = False
        self.create_service(Trigger, "~/take_reference", self._take_reference)
        # Steady, because simulated time may stand still.
        self.create_timer(1.0, self._look, clock=Steady(clock_type=ClockType.STEADY_TIME))

    def value(self, name: str) -> Any:
        """Value of a parameter."""
        return self.get_parameter(name).value

    # -- life cycle ---------------------------------------------------------------------------------------

    def on_configure(self, state: State) -> TransitionCallbackReturn:
        """Validate the parameters and create the topics."""
        del state
        try:
            self._make_topics()
        except ValueError as error:
            self.get_logger().error(str(error))
            self._forget()
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: State) -> TransitionCallbackReturn:
        """Connect to tactflow, which may start before or after."""
        endpoint, sensor = self.value("endpoint"), self.value("sensor")
        self._health, self._run = Health(), {}
        # Publishers first: a message may arrive immediately.
        result = super().on_activate(state)
        try:
            self._link = Link(endpoint, sensor, self.value("keys"), self._received)
        except LinkError as error:
            self.get_logger().error(str(error))
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        self.get_logger().info(f"sensor {sensor} from {endpoint}")
        return result

    def on_deactivate(self, state: State) -> TransitionCallbackReturn:
        """Disconnect."""
        self.disconnect()
        return super().on_deactivate(state)

    def on_cleanup(self, state: State) -> TransitionCallbackReturn:
        """Remove the topics."""
        del state
        self._forget()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: State) -> TransitionCallbackReturn:
        """Like `on_cleanup`, from any state."""
        self.disconnect()
        return self.on_cleanup(state)

    def disconnect(self) -> None:
        """Stop receiving; idempotent."""
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _forget(self) -> None:
        for publisher in self._topics.values():
            self.destroy_publisher(publisher)
        self._topics = {}

    def _make_topics(self) -> None:
        word = self.value("reliability")
        if word not in ("best_effort", "reliable"):
            raise ValueError(f"reliability: required best_effort or reliable, got {word!r}")
        if self.value("surface_step") < 1:
            raise ValueError(f"surface_step: required 1 or more, got {self.value('surface_step')}")
        reliability = QoSReliabilityPolicy[word.upper()]
        qos = QoSProfile(depth=QUEUE_DEPTH, reliability=reliability, durability=QoSDurabilityPolicy.VOLATILE)
        kinds = dict(UNITLESS)
        for name, (kind, _) in GEOMETRY.items():
            kinds |= {name: kind, f"{name}_pixels": kind}
        for name, kind in kinds.items():
            self._topics[name] = self.create_lifecycle_publisher(kind, f"~/{name}", qos)
        if self.value("publish_clock"):
            self._topics["/clock"] = self.create_lifecycle_publisher(Clock, "/clock", qos)
        if self.value("object_frame_id") and TFMessage is None:
            self.get_logger().warning("no /tf: tf2_msgs is missing; apt install ros-$ROS_DISTRO-tf2-msgs")
        elif self.value("object_frame_id"):
            self._topics["/tf"] = self.create_lifecycle_publisher(TFMessage, "/tf", TF_QOS)
        self._topics["/diagnostics"] = self.create_publisher(DiagnosticArray, "/diagnostics", QUEUE_DEPTH)

    # -- messages -----------------------------------------------------------------------------------------

    def _received(self, name: str, message: messages.Message, data: bytes) -> None:
        """Handle a message of tactflow, in the link's thread."""
        frame_id = self.value("frame_id")
        if name == "stats":
            self._run = message
        elif name == "tactflow_picture":
            self._topics["image/compressed"].publish(messages.picture(message, data, frame_id))
        elif name == "tactflow_depth":
            self._offer("depth", lambda: messages.depth(message, data, frame_id))
            self._offer("surface", lambda: self._surface(message, data, messages.header(message, frame_id)))
        else:
            self._health.note(message)
            self._publish(message, messages.header(message, frame_id))

    def _surface(self, message: messages.Message, data: bytes, head: Any) -> PointCloud2 | None:
        """None until a result has told the scale."""
        if self._unit is messages.PIXELS:
            return None
        return surface(message, data, head, self._unit, self.value("surface_step"))

    def _publish(self, message: messages.Message, head: Any) -> None:
        self._warn_replay(message["t"])
        self._offer("/clock", lambda: Clock(clock=head.stamp))
        self._offer("touching", lambda: Bool(data=message["contact"] is not None))
        slip = message.get("slip")
        self._offer("slipping", lambda: None if slip is None else Bool(data=slip["slipping"]))
        units = messages.units(message)
        self._unit = units[-1]
        for unit in units:
            for name, (_, make) in GEOMETRY.items():
                self._offer(name + unit.suffix, lambda make=make, unit=unit: make(message, head, unit))
        self._offer("wrench", lambda: messages.wrench(message, head))
        pose = messages.object_pose(message, head)
        self._offer("object_pose", lambda: pose)
        if pose is not None:
            frame = messages.transform(pose, self.value("object_frame_id"))
            self._offer("/tf", lambda: TFMessage(transforms=[frame]))

    def _offer(self, topic: str, make: Callable[[], Any]) -> None:
        """Create and publish a message, unless the topic has no subscribers or there is nothing to
        publish."""
        publisher = self._topics.get(topic)
        if publisher is not None and publisher.get_subscription_count():
            message = make()
            if message is not None:
                publisher.publish(message)

    def _warn_replay(self, t: float) -> None:
        if t > messages.MIN_UNIX_TIME_S or self._warned_replay or self.value("use_sim_time"):
            return
        self._warned_replay = True
        self.get_logger().warning(
            "this is a recording: its stamps count from its beginning, not from 1970; for nodes that compare "
            "them with the current time, set use_sim_time everywhere and publish_clock here"
        )

    # -- service and diagnostics --------------------------------------------------------------------------

    def _take_reference(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        del request
        if control := self.value("control"):
            answer = send_command(control, "take_reference", self.value("keys"), ANSWER_SECONDS)
            response.success, response.message = answer
        else:
            response.message = (
                "the parameter control is not set; run tactflow with --set "
                "sinks.zmq.control=tcp://127.0.0.1:5557 and set control to the same"
            )
        return response

    def _look(self) -> None:
        """Once a second: update the subscriptions and publish diagnostics."""
        link = self._link
        if link is None:
            return
        link.want(sent for topic, sent in ON_DEMAND.items() if self._topics[topic].get_subscription_count())
        level, words, numbers = self._health.report(self._run)
        condition = self._condition(link) or (level, words)
        numbers["damaged messages"] = link.damaged
        report = diagnostics((*condition, numbers), self.value("sensor"), self.value("endpoint"))
        report.header.stamp = self.get_clock().now().to_msg()
        self._topics["/diagnostics"].publish(report)

    def _condition(self, link: Link) -> tuple[bytes, str] | None:
        """Why nothing is received; None if something is."""
        if link.refused is not None:
            return DiagnosticStatus.ERROR, link.refused
        silent = self._health.age
        if silent > self.value("timeout"):
            since = f"for {silent:.0f} s" if self._health.frames else "since the start"
            return DiagnosticStatus.STALE, (
                f"no message {since}; is tactflow running and publishing there, and is its sensor called "
                f"{self.value('sensor')}?"
            )
        return None


def main() -> int:
    """Run the node until shutdown."""
    rclpy.init()
    try:
        node = Bridge()
    except ParameterException as error:
        get_logger("tactflow").error(f"{error}; a DOUBLE needs a decimal point, as in 2.0")
        rclpy.try_shutdown()
        return 1
    try:
        if node.value("autostart"):
            done = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != done or node.trigger_activate() != done:
                return 1
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    except Exception:
        # After Ctrl-C, rclpy refuses whatever is being done, also while the node still starts.
        if rclpy.ok():
            raise
    finally:
        node.disconnect()
        rclpy.try_shutdown()
    return 0
