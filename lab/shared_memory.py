"""Measure what pictures cost on their way to other processes: shared memory, ROS 2, JPEG over ZeroMQ.

    python lab/shared_memory.py                  # 4 sensors, 2 readers each, 60 Hz, 800 x 600
    python lab/shared_memory.py --sensors 1

Each sensor is a process that hands pictures of a simulated gel to the sink alone, at a fixed rate, so that
the cost is that of the transport. Each reader gets the pictures as arrays, with their messages. The images of
ROS 2 (`ros_images.py`, after `make ros-env`) have no messages with them. The table has the CPU time of a
picture (user and system, all threads), which other load on the machine changes least, and the share of one
processor that this is at the full rate.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import orjson
import zmq

import tactflow
from tactflow import Frame, Result, SharedReader
from tactflow.plugins.shm.sink import Shm
from tactflow.sinks.zmq import Zmq

RATE_HZ = 60.0
"""Rate of the pictures, as of a fast tactile camera."""
CYCLE_FRAMES = 12
"""Pictures that are repeated: enough for JPEG to see different ones."""
WARM_UP_FRAMES = 30
"""Pictures before the clock starts."""
TRANSPORTS = {
    "shm": "shared memory",
    "ros": "`sensor_msgs/Image` of ROS 2 (rclpy, Fast DDS)",
    "jpeg": "JPEG (quality 80) over ZeroMQ",
}
ROS_PYTHON = Path(__file__).resolve().parents[1] / ".venv-ros" / "bin" / "python"
ROS_ENVIRONMENT = {"ROS_DOMAIN_ID": "77", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
"""So that its nodes find each other alone."""
BASE_PORT = 5790
"""First of the TCP ports that are used, one per sensor."""


def write(transport: str, sensor: int, readers: int, frames: int) -> None:
    """Feed one sink; prints the CPU time per picture, ms, and the achieved rate, Hz."""
    scene = tactflow.open_scene("press?frames=60")
    pictures = [np.ascontiguousarray(scene.frame(30 + i)) for i in range(CYCLE_FRAMES)]
    sink: Any
    if transport == "shm":
        sink = Shm(Shm.Params(ports=("image",)), f"lab{sensor}")
    else:
        endpoint = f"tcp://127.0.0.1:{BASE_PORT + sensor}"
        sink = Zmq(Zmq.Params(endpoint=endpoint, pictures=240, linger=0), f"lab{sensor}")
    sink.open()
    connected = "readers" if transport == "shm" else "subscriptions"
    # Two subscribers to one topic count as one subscription.
    needed = readers if transport == "shm" else 1
    while not sink.wants() or sink.counters()[connected] < needed:
        time.sleep(0.01)
    time.sleep(1.0)
    start, used = time.perf_counter(), 0.0
    for seq in range(WARM_UP_FRAMES + frames):
        if seq == WARM_UP_FRAMES:
            used, start = time.process_time(), time.perf_counter() - seq / RATE_HZ
        time.sleep(max(0.0, start + seq / RATE_HZ - time.perf_counter()))
        image = pictures[seq % CYCLE_FRAMES]
        sink.write(Result(Frame(f"lab{sensor}", seq, seq / RATE_HZ, image), {"image": image}))
    cpu = 1e3 * (time.process_time() - used) / frames
    rate = frames / (time.perf_counter() - start - WARM_UP_FRAMES / RATE_HZ)
    print(json.dumps([cpu, rate]), flush=True)
    time.sleep(1.0)
    sink.close()


def shared_pictures(sensor: int) -> Iterator[tuple[Any, Any]]:
    """Pictures and messages from shared memory."""
    with SharedReader(f"lab{sensor}", "image", timeout=60) as reader:
        for picture in reader:
            yield picture.array, picture.message


def decoded_pictures(sensor: int) -> Iterator[tuple[Any, Any]]:
    """Pictures that were sent as JPEG, and what came with them."""
    socket = zmq.Context().socket(zmq.SUB)
    socket.subscribe(f"tactflow_picture.lab{sensor}")
    socket.connect(f"tcp://127.0.0.1:{BASE_PORT + sensor}")
    while True:
        message = socket.recv()
        head, _, data = message.partition(b"\n")
        yield (
            cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR),
            orjson.loads(head.partition(b" ")[2]),
        )


def read(transport: str, sensor: int, frames: int) -> None:
    """Take pictures; prints the CPU time per picture, ms, and how many there were."""
    source: Callable[[int], Iterator[tuple[Any, Any]]]
    source = shared_pictures if transport == "shm" else decoded_pictures
    used, count = 0.0, 0
    for array, message in source(sensor):
        if message["seq"] < WARM_UP_FRAMES:
            used, count = time.process_time(), 0
            continue
        assert array.shape == (600, 800, 3)
        count += 1
        if message["seq"] >= WARM_UP_FRAMES + frames - 1:
            break
    print(json.dumps([1e3 * (time.process_time() - used) / count, count]), flush=True)


def measure(transport: str, sensors: int, readers: int, frames: int) -> str:
    """A row of the table."""

    def start(role: str, sensor: int) -> subprocess.Popen[str]:
        if transport == "ros":
            program, numbers = ROS_PYTHON.parents[2] / "lab" / "ros_images.py", [readers, frames]
            given = [role, sensor, *numbers[role == "read" :]]
            command = [str(ROS_PYTHON), str(program), *map(str, given)]
            return subprocess.Popen(
                command, stdout=subprocess.PIPE, text=True, env=os.environ | ROS_ENVIRONMENT
            )
        command = [sys.executable, __file__, "--frames", str(frames), "--readers", str(readers), "--role"]
        return subprocess.Popen([*command, role, transport, str(sensor)], stdout=subprocess.PIPE, text=True)

    writing = [start("write", sensor) for sensor in range(sensors)]
    reading = [start("read", sensor) for sensor in range(sensors) for _ in range(readers)]
    writers = [json.loads(process.communicate()[0]) for process in writing]
    seen = [json.loads(process.communicate()[0]) for process in reading]
    writer, reader = (statistics.median(cpu for cpu, _ in values) for values in (writers, seen))
    share = (writer + readers * reader) * RATE_HZ * sensors / 10
    rate = statistics.median(rate for _, rate in writers)
    got = 100 * statistics.mean(count / frames for _, count in seen)
    times = f"{writer:.2f} | {reader:.2f} | {share:.0f} %"
    return f"| {TRANSPORTS[transport]} | {sensors} | {times} | {rate:.0f} Hz | {got:.0f} % |"


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description="CPU time of pictures on their way to other processes.")
    parser.add_argument("--sensors", type=int, nargs="+", default=[4, 1])
    parser.add_argument("--readers", type=int, default=2, help="of each sensor (default: 2)")
    parser.add_argument("--frames", type=int, default=600, help="that are measured (default: 600)")
    parser.add_argument("--turns", type=int, default=1, help="of each transport, in turns")
    parser.add_argument("--role", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role is not None:
        role, transport, sensor = args.role
        if role == "write":
            write(transport, int(sensor), args.readers, args.frames)
        else:
            read(transport, int(sensor), args.frames)
        return
    print("| transport | sensors | writer, ms a picture | reader, ms | share of a processor | rate | got |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for sensors in args.sensors:
        for _ in range(args.turns):
            for transport in TRANSPORTS:
                if transport == "ros" and not ROS_PYTHON.exists():
                    continue
                print(measure(transport, sensors, args.readers, args.frames), flush=True)


if __name__ == "__main__":
    main()
