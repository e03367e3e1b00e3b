"""The script for ROS 1, with Debian's rospy and a master of its own."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.zmq import Zmq
from tests.clock import LOOK_SECONDS, until
from tests.conftest import REPOSITORY
from tests.messages import result_of
from tests.ros.test_bridge import CONTACT, IMAGE, RESULTS

PYTHON = "/usr/bin/python3"
PACKAGES = [Path("/usr/lib/python3/dist-packages", name) for name in ("rospy", "rosmaster", "zmq")]
NEEDED = "rospy is not here: make system-deps, on Debian 12"
IN_BOTH_UNITS = ("contact", "contact_pose", "flow")
TOPICS = ("touching", *IN_BOTH_UNITS, *(f"{topic}_pixels" for topic in IN_BOTH_UNITS))
LISTEN = f"""
import json
import rospy
from geometry_msgs.msg import PolygonStamped, PoseStamped, Vector3Stamped
from std_msgs.msg import Bool
kinds = dict(touching=Bool, contact=PolygonStamped, contact_pose=PoseStamped, flow=Vector3Stamped)
rospy.init_node("listener")
for topic in {TOPICS}:
    message = rospy.wait_for_message("/tactflow/" + topic, kinds[topic.replace("_pixels", "")])
    print(json.dumps([topic, str(message)]), flush=True)
"""


@contextmanager
def program(*command: str, port: int, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A program of ROS 1 on this machine alone, ended at the end."""
    places = {"ROS_MASTER_URI": f"http://127.0.0.1:{port}", "ROS_IP": "127.0.0.1"}
    process = subprocess.Popen(command, env=os.environ | places, text=True, **options)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def listens(port: int) -> bool:
    """Whether somebody does there."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.skipif(not all(package.exists() for package in PACKAGES), reason=NEEDED)
def test_every_topic_reaches_a_subscriber_with_its_capture_time_and_unit(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    sink = Zmq(Zmq.Params(endpoint=f"ipc://{tmp_path}/results"))
    sink.open()
    script = str(REPOSITORY / "ros" / "tactflow_ros1.py")
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with ExitStack() as stack:
        master = ["/usr/bin/rosmaster", "--core", "-p", str(port)]
        stack.enter_context(program(*master, port=port, **quiet))
        until(lambda: listens(port))
        stack.enter_context(program(PYTHON, script, f"_endpoint:={sink.endpoint}", port=port, **quiet))
        listener = stack.enter_context(program(PYTHON, "-c", LISTEN, port=port, stdout=subprocess.PIPE))
        frame = Frame("main", 0, 1.7e9 + 0.125, IMAGE)
        while listener.poll() is None:
            sink.write(result_of(Tick(frame), RESULTS))
            sink._closing.wait(LOOK_SECONDS)
        assert listener.stdout is not None
        with listener.stdout as lines:
            told = dict(json.loads(line) for line in lines)
    sink.close()
    assert tuple(told) == TOPICS
    assert told["touching"] == "data: True"
    assert "secs: 1700000000\n    nsecs: 125000000" in told["contact_pixels"]
    x, y = CONTACT.center
    assert f"x: {x}\n    y: {y}" in told["contact_pose_pixels"]
    assert "x: 0.002\n    y: 0.003" in told["contact_pose"]
    assert told["contact"].count("x: 0.00") == len(CONTACT.hull)
    assert "x: 1.5\n  y: -2.0" in told["flow_pixels"]
    assert "x: 0.00015" in told["flow"]
