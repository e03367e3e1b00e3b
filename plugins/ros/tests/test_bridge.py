"""The ROS 2 bridge: what tactflow publishes reaches real subscribers of rclpy in another process."""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plugins.ros.tests.programs import Program, needs_rclpy
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.network.keys import make_keys
from tactflow.sinks.zmq import Zmq
from tactflow.vision.types import Contact, Depth, Flow, Force, Markers, Pose, Scale, Slip
from tests.clock import until
from tests.messages import Results
from tests.paths import REPOSITORY
from tests.sinks.test_view import fake_run

IMAGE = np.full((40, 60, 3), 90, np.uint8)
CONTACT = Contact(200.0, (30.0, 20.0), 30.0, -0.577, np.array([[25.0, 15], [35, 15], [30, 28]]), None)
MARKERS = Markers(
    np.array([[10.0, 10], [50, 30]]),
    np.array([[11.0, 10.5], [50, 30]]),
    np.array([0, 2], np.uint8),
    np.array([0.25, np.nan]),
)
HEIGHTS = np.linspace(0, 1, 40 * 60, dtype=np.float32).reshape(40, 60)
RESULTS = Results(
    IMAGE,
    CONTACT,
    Flow((1.5, -2.0), 1),
    MARKERS,
    Scale(0.1, 0.2, (0.001, 0.001), (10.0, 5.0)),
    Depth(HEIGHTS, 1.0, None, 3.0, None),
    slip=Slip(True, 0.0, 0.9, (3.0, -4.0), 90.0, 60.0, 0),
    force=Force((None, None, 2.5), (None, None, 0.2), True),
    pose=Pose("tracked", 0, (1.0, 2.0, -0.5), (0.5, 0.0, 0.25), (0.0, 0.0, 90.0), np.eye(6)),
)
T = 12.123456789
"""Capture time of the first frame, s: a recording's."""
NODE = ["--ros-args", "-r", "__ns:=/left", "-p", "sensor:=left"]


class Pair:
    """tactflow's sink in this process, the bridge and a listener in two others."""

    def __init__(self) -> None:
        self.run = fake_run()
        self.sink = self._sink("tcp://127.0.0.1:*", "tcp://127.0.0.1:*")
        self.control = self.sink.control_endpoint or ""
        given = {
            "endpoint": self.sink.endpoint,
            "control": self.control,
            "frame_id": "gel",
            "publish_clock": "true",
            "use_sim_time": "true",
            "timeout": "0.5",
        }
        options = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
        self.listener = Program(str(Path(__file__).with_name("listener.py")))
        self.bridge = Program("-m", "tactflow_ros", *NODE, *options)
        self.listener.told(lambda told: "ready" in told)
        self._results = RESULTS
        self.reasons: dict[str, str] = {}
        self._seq = 0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._publish)
        self._thread.start()

    def _sink(self, endpoint: str, control: str) -> Zmq:
        params = Zmq.Params(endpoint=endpoint, control=control, detail=True, pictures=100, stats_every=0.1)
        sink = Zmq(params, "left", self.run)
        sink.open()
        return sink

    def restart(self, meanwhile: Callable[[], None]) -> None:
        """End tactflow, and start it again at the same addresses."""
        old = self.sink
        old.close()
        meanwhile()
        self.sink = self._sink(old.endpoint, self.control)

    def _publish(self) -> None:
        """A frame every 20 ms, as a camera would."""
        while not self._end.wait(0.02):
            frame = Frame("left", self._seq, T + self._seq / 50, IMAGE)
            self.sink.write(Result(frame, self._results._asdict(), self.reasons))
            self._seq += 1

    def receive(self, topic: str, results: Results = RESULTS) -> dict[str, Any]:
        """What is received of a topic after the results have changed to these."""
        self._results = results
        begun = T + (self._seq + 1) / 50

        def new(told: dict[str, Any]) -> bool:
            head = told.get("message", {}).get("header")
            return told.get("topic") == topic and (head is None or seconds(head["stamp"]) >= begun)

        found: dict[str, Any] = self.listener.told(new)["message"]
        return found

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self.listener.end()
        self.bridge.end()
        self.sink.close()


def seconds(stamp: dict[str, int]) -> float:
    return stamp["sec"] + stamp["nanosec"] / 1e9


@pytest.fixture(scope="module")
def pair() -> Iterator[Pair]:
    pair = Pair()
    yield pair
    pair.close()


def points(polygon: dict[str, Any]) -> list[tuple[float, float]]:
    return [(point["x"], point["y"]) for point in polygon["polygon"]["points"]]


@needs_rclpy
def test_lengths_arrive_in_metres_where_there_is_a_scale_and_in_pixels_under_that_name(pair: Pair) -> None:
    head = pair.receive("contact")["header"]
    assert head["frame_id"] == "gel"
    frames_since = (seconds(head["stamp"]) - T) * 50
    assert frames_since == pytest.approx(round(frames_since), abs=1e-6)
    places = [(0.0015, 0.002), (0.0025, 0.002), (0.002, 0.0046)]
    assert np.array(points(pair.receive("contact"))) == pytest.approx(np.array(places))
    assert np.array(points(pair.receive("contact_pixels"))) == pytest.approx(CONTACT.hull)
    position = pair.receive("contact_pose")["pose"]["position"]
    assert (position["x"], position["y"], position["z"]) == pytest.approx((0.002, 0.003, 0))
    in_pixels = pair.receive("contact_pose_pixels")["pose"]
    assert (in_pixels["position"]["x"], in_pixels["position"]["y"]) == (30, 20)
    turned = in_pixels["orientation"]
    # Counter-clockwise as seen is against the axis that points into the picture.
    assert 2 * math.degrees(math.atan2(turned["z"], turned["w"])) == pytest.approx(-30)
    for topic, expected in (("flow", (0.00015, -0.0004)), ("flow_pixels", (1.5, -2.0))):
        vector = pair.receive(topic)["vector"]
        assert (vector["x"], vector["y"], vector["z"]) == pytest.approx((*expected, 0))


@needs_rclpy
def test_a_cloud_has_a_point_for_each_marker(pair: Pair) -> None:
    for topic, scale, origin in (("markers", (1e-4, 2e-4), (10, 5)), ("markers_pixels", (1, 1), (0, 0))):
        cloud = pair.receive(topic)
        assert (cloud["width"], cloud["height"]) == (2, 1)
        names = [field["name"] for field in cloud["fields"]]
        kind = {"names": names, "formats": ["<f4"] * 6 + ["u1"], "itemsize": cloud["point_step"]}
        kind["offsets"] = [field["offset"] for field in cloud["fields"]]
        rows = np.frombuffer(bytes(cloud["data"]), np.dtype(kind))
        assert rows["status"].tolist() == MARKERS.status.tolist()
        assert (rows[0]["x"], rows[0]["y"]) == pytest.approx(
            ((11 - origin[0]) * scale[0], (10.5 - origin[1]) * scale[1])
        )
        assert (rows[0]["dx"], rows[0]["dy"]) == pytest.approx((scale[0], 0.5 * scale[1]))
        assert rows[0]["stderr"] == pytest.approx(0.25 * math.sqrt(scale[0] * scale[1]))
        assert math.isnan(rows[1]["stderr"])


@needs_rclpy
def test_touch_slip_force_depth_and_picture_arrive(pair: Pair) -> None:
    assert pair.receive("touching") == {"data": True}
    assert pair.receive("slipping") == {"data": True}
    for topic, expected in (("slip", (0.0003, -0.0008)), ("slip_pixels", (3.0, -4.0))):
        pose = pair.receive(topic)["pose"]
        assert (pose["position"]["x"], pose["position"]["y"]) == pytest.approx(expected)
        assert list(pose["orientation"].values()) == pytest.approx([0, 0, -(0.5**0.5), 0.5**0.5])
    force = pair.receive("wrench")["wrench"]["force"]
    assert math.isnan(force["x"])
    assert force["z"] == -2.5
    torque = pair.receive("wrench")["wrench"]["torque"]
    assert (torque["x"], torque["y"]) == pytest.approx((0.003 * -2.5, -0.002 * -2.5))
    assert math.isnan(torque["z"])
    pose = pair.receive("object_pose")["pose"]
    assert list(pose["position"].values()) == pytest.approx([1.5e-3, 2e-3, -0.25e-3])
    assert list(pose["orientation"].values()) == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    depth = pair.receive("depth")
    assert (depth["width"], depth["height"], depth["encoding"]) == (60, 40, "32FC1")
    metres = np.frombuffer(bytes(depth["data"]), np.float32).reshape(40, 60)
    assert metres == pytest.approx(HEIGHTS * 1e-3)
    picture = pair.receive("image/compressed")
    assert picture["format"] == "jpeg"
    assert bytes(picture["data"][:2]) == b"\xff\xd8"


@needs_rclpy
def test_a_wrench_has_the_torque_about_the_origin_of_the_frame(pair: Pair) -> None:
    force = Force((0.5, -0.25, 2.5), (0.1, 0.1, 0.1), True, torque=4.0)
    wrench = pair.receive("wrench", RESULTS._replace(force=force))["wrench"]
    at, along, twist = np.array([0.002, 0.003, 0]), np.array([0.5, -0.25, -2.5]), np.array([0, 0, 0.004])
    assert list(wrench["force"].values()) == pytest.approx(along)
    assert list(wrench["torque"].values()) == pytest.approx(np.cross(at, along) + twist)
    # A soft object that covers all of the gel has no outline.
    torque = pair.receive("wrench", RESULTS._replace(contact=None, flow=None))["wrench"]["torque"]
    assert np.isnan(list(torque.values())).all()


@needs_rclpy
def test_the_surface_is_a_cloud_with_normals(pair: Pair) -> None:
    cloud = pair.receive("surface")
    assert (cloud["width"], cloud["height"], cloud["header"]["frame_id"]) == (30, 20, "gel")
    assert [field["name"] for field in cloud["fields"]] == ["x", "y", "z", "normal_x", "normal_y", "normal_z"]
    x, y, z, *normal = np.frombuffer(bytes(cloud["data"]), np.float32).reshape(20, 30, 6).transpose(2, 0, 1)
    rows, columns = np.mgrid[:40:2, :60:2]
    assert x == pytest.approx((columns - 10) * 1e-4)
    assert y == pytest.approx((rows - 5) * 2e-4)
    assert z == pytest.approx(HEIGHTS[::2, ::2] * -1e-3)
    # The depth grows by as much from pixel to pixel everywhere; pixels are 0.1 mm wide and 0.2 mm high.
    step = 1 / (40 * 60 - 1)
    slopes = np.array([step / 0.1, 60 * step / 0.2, 1])
    expected = slopes / np.linalg.norm(slopes)
    assert np.dstack(normal) == pytest.approx(np.broadcast_to(expected, (20, 30, 3)), abs=1e-4)
    flat = np.frombuffer(bytes(pair.receive("surface", without_contact(RESULTS))["data"]), np.float32)
    assert (flat.reshape(-1, 6)[:, 2:] == [0, 0, 0, 1]).all()


@needs_rclpy
def test_the_pose_of_the_object_is_a_transform_while_it_is_tracked(pair: Pair) -> None:
    told = pair.receive("/tf")
    assert (told["header"]["frame_id"], told["child_frame_id"]) == ("gel", "tactile_object")
    assert list(told["transform"]["translation"].values()) == pytest.approx([1.5e-3, 2e-3, -0.25e-3])
    assert list(told["transform"]["rotation"].values()) == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])


@needs_rclpy
def test_without_the_messages_of_tf_the_bridge_runs_and_says_what_to_install() -> None:
    program = "import sys; sys.modules['tf2_msgs'] = None; from tactflow_ros.__main__ import main; main()"
    bridge = Program("-c", program)
    until(lambda: any("sensor main from" in line for line in bridge.complaints))
    bridge.end()
    assert any("no /tf: tf2_msgs is missing; apt install" in line for line in bridge.complaints)


@needs_rclpy
def test_without_a_contact_the_outline_is_empty_and_nothing_is_made_up(pair: Pair) -> None:
    nothing = without_contact(RESULTS)
    first = pair.receive("contact_pixels", nothing)
    began = seconds(first["header"]["stamp"])
    assert points(first) == []
    pair.listener.told(lambda told: told.get("topic") == "touching" and not told["message"]["data"])
    assert not np.frombuffer(bytes(pair.receive("depth", nothing)["data"]), np.float32).any()
    last = pair.receive("contact_pixels", nothing)["header"]["stamp"]
    # Poses from before may still come; none is of a frame without a contact.
    told = [json.loads(line) for line in list(pair.listener.said) if "contact_pose" in line]
    assert told
    assert max(seconds(one["message"]["header"]["stamp"]) for one in told) < began <= seconds(last)


def without_contact(results: Results) -> Results:
    """The same without anything that a contact brings."""
    return results._replace(contact=None, flow=None, depth=None, slip=None, force=None)


@needs_rclpy
def test_the_clock_is_the_recordings_and_the_node_goes_by_it(pair: Pair) -> None:
    clock = seconds(pair.receive("/clock")["clock"])
    assert T <= clock < T + 600
    report = pair.receive("/diagnostics")
    assert 0 < seconds(report["header"]["stamp"]) < T + 600


@needs_rclpy
def test_the_diagnostics_tell_rate_drops_and_lost_markers(pair: Pair) -> None:
    def undisturbed(told: dict[str, Any]) -> bool:
        """A report about a second in which neither the sink nor the bridge was held up."""
        if told.get("topic") != "/diagnostics":
            return False
        found = numbers(told["message"])
        return 1 < found["rate, Hz"] < 60 and found["frames missing"] == 0

    report = pair.listener.told(undisturbed)["message"]
    (status,), values = report["status"], numbers(report)
    assert (status["name"], status["message"]) == ("tactflow: left", "receiving")
    assert values["lost markers, share"] == 0.5
    assert 0 <= values["age of the last message, s"] < 0.5
    assert {"latency of the run, p99, ms", "frames dropped by the run", "damaged messages"} <= values.keys()


@needs_rclpy
def test_the_diagnostics_warn_of_damaged_pictures_and_of_lost_markers(pair: Pair) -> None:
    def warned(told: dict[str, Any], words: str) -> bool:
        return told.get("topic") == "/diagnostics" and words in told["message"]["status"][0]["message"]

    before = numbers(pair.receive("/diagnostics"))["new references so far"]
    pair.reasons = {"contact": "damaged", "reference": "light_changed"}
    report = pair.listener.told(lambda told: warned(told, "most pictures are damaged: check the camera"))
    pair.reasons = {}
    found = numbers(report["message"])
    assert 0.5 < found["damaged pictures, share"] <= 1
    assert found["new references so far"] > before
    pair.receive("touching", RESULTS._replace(markers=replace(MARKERS, status=np.full(2, 2, np.uint8))))
    pair.listener.told(lambda told: warned(told, "most markers are lost: take a new reference"))
    pair.receive("touching")


def numbers(report: dict[str, Any]) -> dict[str, float]:
    """What a report of the diagnostics has measured."""
    (status,) = report["status"]
    return {pair["key"]: float(pair["value"]) for pair in status["values"]}


@needs_rclpy
def test_damaged_messages_are_passed_over_and_counted(pair: Pair) -> None:
    for text in (b"{broken", b"[]", b"7", b'{"sensor": "left"}', b'{"sensor": "left", "seq": 1}\nx', b"\xff"):
        pair.sink._publisher.send(b"tactflow.left " + text)
    for text in (b'{"sensor": "left", "t": 1.0}\n', b'{"sensor": "left", "t": 1.0, "size": [9, 9]}\n123'):
        pair.sink._publisher.send(b"tactflow_depth.left " + text)
    far = {"sensor": "left", "seq": 1, "t": 1e300, "contact": None, "flow": None, "markers": None}
    pair.sink._publisher.send(b"tactflow.left " + json.dumps(far).encode())

    def nine_counted(told: dict[str, Any]) -> bool:
        return told.get("topic") == "/diagnostics" and numbers(told["message"])["damaged messages"] == 9

    pair.listener.told(nine_counted)
    assert pair.receive("touching") == {"data": True}


@needs_rclpy
def test_when_tactflow_has_ended_that_is_told_and_its_next_run_is_taken_up(pair: Pair) -> None:
    def silent(told: dict[str, Any]) -> bool:
        return told.get("topic") == "/diagnostics" and "no message for" in str(told)

    pair.restart(lambda: pair.listener.told(silent) and None)
    assert pair.receive("touching") == {"data": True}


@needs_rclpy
def test_the_service_takes_a_new_reference_in_the_run(pair: Pair) -> None:
    pair.listener.order(do="call")
    answer = pair.listener.told(lambda told: "success" in told)
    assert answer == {"success": True, "said": "the next frame is taken as the reference"}
    pair.run.retake_reference.assert_called_once_with()


@needs_rclpy
@pytest.mark.parametrize(
    ("parameters", "state", "words"),
    [
        ({"reliability": "perhaps"}, "configured", "required best_effort or reliable, got 'perhaps'"),
        ({"surface_step": 0}, "configured", "surface_step: required 1 or more, got 0"),
        ({"endpoint": "nowhere"}, "activated", "required an address such as tcp://127.0.0.1:5556"),
        ({"keys": "/nowhere"}, "activated", "tactflow keys new creates such a folder"),
    ],
)
def test_parameters_that_cannot_be_are_refused_with_what_to_do(
    parameters: dict[str, Any], state: str, words: str, pair: Pair
) -> None:
    pair.listener.order(do="configure", parameters=parameters)
    assert pair.listener.told(lambda told: "configured" in told)[state] == "FAILURE"
    until(lambda: any(words in line for line in pair.listener.complaints))


@needs_rclpy
def test_silence_and_keys_that_are_refused_are_told(pair: Pair, tmp_path: Path) -> None:
    own, _ = make_keys(tmp_path / "keys", "robot")
    _, stranger = make_keys(tmp_path / "other", "robot")
    (stranger / "publisher.key").write_bytes((own / "publisher.key").read_bytes())
    sink = Zmq(Zmq.Params(endpoint="tcp://127.0.0.1:*", keys=str(own)))
    sink.open()
    for keys in ("", str(stranger)):
        told = condition(pair, {"endpoint": sink.endpoint, "keys": keys, "timeout": 60.0})
        assert "requires other keys, or any: set the parameter keys" in told["condition"]
    sink.close()
    silent = condition(pair, {"endpoint": f"ipc://{tmp_path}/nobody", "timeout": 0.1})
    assert "no message since the start; is tactflow running" in silent["condition"]
    assert "the parameter control is not set" in silent["service"]
    nobody = condition(pair, {"endpoint": f"ipc://{tmp_path}/nobody", "timeout": 0.1, "control": "nowhere"})
    assert "required an address" in nobody["service"]


def condition(pair: Pair, parameters: dict[str, Any]) -> dict[str, Any]:
    """How a bridge with these parameters finds itself."""
    pair.listener.order(do="configure", parameters=parameters)
    return pair.listener.told(lambda told: "configured" in told)


@needs_rclpy
def test_the_example_closes_until_something_touches_and_tightens_while_it_slips(pair: Pair) -> None:
    # So wide that it never closes altogether while nothing touches.
    given = ("-p", "sensor:=left", "-p", "width:=100.0")
    example = Program(str(REPOSITORY / "examples" / "ros2" / "hold.py"), "--ros-args", *given)
    try:
        pair.receive("touching", without_contact(RESULTS))
        until(lambda: closing(pair) == pytest.approx(0.0005))
        pair.receive("slipping", RESULTS._replace(slip=Slip(False, 1.0)))
        until(lambda: closing(pair) == 0)
        pair.receive("slipping", RESULTS)
        until(lambda: closing(pair) == pytest.approx(0.0001))
    finally:
        example.end()


def closing(pair: Pair) -> float:
    """By how much the example closes the gripper from one frame to the next."""
    before, after = (pair.listener.told(lambda told: told.get("topic") == "/hold/width") for _ in range(2))
    return float(before["message"]["data"] - after["message"]["data"])
