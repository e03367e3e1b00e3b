"""What the ROS 2 bridge adds: tactflow -> ZeroMQ -> bridge -> a subscriber of rclpy, each a process.

    python -m tests.ros.latency --seconds 60

prints how many messages were sent and received, whether their stamps are the capture times, and how much
later than a plain ZeroMQ subscriber the one in ROS has each message.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tactflow.network.subscriber import Subscriber
from tests.clock import until
from tests.ros.programs import LISTENER, Program

TOPIC = "contact_pixels"
RATE = 60.0
"""Of the simulated camera, Hz."""
SILENCE = 10.0
"""So long without a message, and the run has ended, s."""


class Passage(NamedTuple):
    """One run.

    sent : messages of the sink zmq. received : by the subscriber in ROS. stamps_equal : whether each has the
    capture time of its frame. added_ms : (N,) how much later than over ZeroMQ alone. rate : Hz, as received.
    """

    sent: int
    received: int
    stamps_equal: bool
    added_ms: np.ndarray
    rate: float


def measure(seconds: float, folder: Path) -> Passage:
    """Run all of it for so long. folder : for the statistics of the run, and its address."""
    endpoint = f"ipc://{folder}/results"
    listener = Program(str(LISTENER), TOPIC)
    listener.told(lambda told: "ready" in told)
    options = ["-p", "sensor:=main", "-p", f"endpoint:={endpoint}"]
    bridge = Program("-m", "tactflow_ros", "--ros-args", "-r", "__ns:=/left", *options)
    until(lambda: any("sensor main" in line for line in bridge.complaints), lambda: bridge.complaints)
    listener.order(do="wait for", topic=TOPIC)
    listener.told(lambda told: "found" in told)
    arrivals: dict[float, int] = {}
    try:
        run = subprocess.Popen(_command(endpoint, round(seconds * RATE), folder))
        # The run waits for its first subscriber, which shall be the bridge.
        listener.told(lambda told: told.get("topic") == TOPIC)
        with Subscriber(endpoint) as direct:
            reader = threading.Thread(target=_note, args=(direct, arrivals))
            reader.start()
            assert run.wait() == 0
            reader.join()
        sent = json.loads((folder / "run.json").read_text())["sinks"]["zmq"]["counters"]["serialised"]
        time.sleep(1)
    finally:
        bridge.end()
        listener.end()
    told = [json.loads(line) for line in listener.said if f'"{TOPIC}"' in line and "message" in line]
    return _compare(sent, arrivals, told)


def _command(endpoint: str, frames: int, folder: Path) -> list[str]:
    """tactflow at the rate of a camera; it begins when somebody listens."""
    sinks = f"sinks={{zmq: {{endpoint: '{endpoint}', wait_for_subscriber: 30}}}}"
    command = [sys.executable, "-m", "tactflow", "run", "default", "--quiet", "--realtime", "--set", sinks]
    return [*command, "--source", f"sim:press?frames={frames}", "--stats", str(folder / "run.json")]


def _note(direct: Subscriber, arrivals: dict[float, int]) -> None:
    """When each message came over ZeroMQ, ns, by its capture time."""
    direct.timeout = SILENCE
    try:
        while True:
            arrivals[direct.receive().t] = time.monotonic_ns()
    except TimeoutError:
        return


def _compare(sent: int, arrivals: dict[float, int], told: list[dict[str, Any]]) -> Passage:
    by_stamp = {math.floor(t) * 1_000_000_000 + round(t % 1 * 1e9): at for t, at in arrivals.items()}
    stamps = []
    for line in told:
        stamp = line["message"]["header"]["stamp"]
        stamps.append(stamp["sec"] * 1_000_000_000 + stamp["nanosec"])
    # The plain subscriber has connected a moment later: only what both have is compared.
    first = min(by_stamp)
    later = [stamp for stamp in stamps if stamp >= first]
    times = [line["at"] for line in told]
    added = [at - by_stamp[stamp] for stamp, at in zip(stamps, times, strict=True) if stamp in by_stamp]
    rate = (len(times) - 1) / ((times[-1] - times[0]) / 1e9)
    return Passage(sent, len(told), set(later) <= by_stamp.keys(), np.array(added) / 1e6, rate)


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description="What the ROS 2 bridge adds.")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the run; default: 60")
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        passage = measure(seconds, Path(folder))
    median, p99 = np.percentile(passage.added_ms, [50, 99])
    print(f"sent {passage.sent}, received {passage.received} at {passage.rate:.1f} Hz")
    print(f"stamps equal the capture times: {passage.stamps_equal}")
    print(f"added latency: median {median:.2f} ms, p99 {p99:.2f} ms, of {len(passage.added_ms)}")


if __name__ == "__main__":
    main()
