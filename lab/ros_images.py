"""Publisher and subscriber of `sensor_msgs/Image`, for `lab/shared_memory.py`.

Runs with the Python of `make ros-env`, which has rclpy and nothing of tactflow:

    ros_images.py write SENSOR READERS FRAMES
    ros_images.py read SENSOR FRAMES

The writer copies each picture into a message, as a node that has it as an array must; the reader takes the
array from the message without a copy. There is no result beside the picture, only its number.
"""

from __future__ import annotations

import json
import math
import sys
import time
from array import array

import numpy as np
import rclpy
from sensor_msgs.msg import Image

RATE_HZ = 60.0
"""Rate of the pictures."""
WARM_UP_FRAMES = 30
"""Pictures before the clock starts."""
CYCLE_FRAMES = 12
"""Pictures that are repeated."""
QUEUE_DEPTH = 10
"""Of publisher and subscribers, which are reliable, as by default."""
SILENCE_S = 10.0
"""Time without a picture after which a reader ends, though it has not seen the last one."""


def write(sensor: str, readers: int, frames: int) -> None:
    """Publish pictures; prints the CPU time per picture, ms, and the achieved rate, Hz."""
    node = rclpy.create_node(f"writer{sensor}")
    publisher = node.create_publisher(Image, f"/lab{sensor}/image", QUEUE_DEPTH)
    pictures = np.random.default_rng(0).integers(0, 255, (CYCLE_FRAMES, 600, 800, 3), np.uint8)
    while publisher.get_subscription_count() < readers:
        time.sleep(0.01)
    time.sleep(1.0)
    start, used = time.perf_counter(), 0.0
    for seq in range(WARM_UP_FRAMES + frames):
        if seq == WARM_UP_FRAMES:
            used, start = time.process_time(), time.perf_counter() - seq / RATE_HZ
        time.sleep(max(0.0, start + seq / RATE_HZ - time.perf_counter()))
        data = array("B")
        data.frombytes(pictures[seq % CYCLE_FRAMES])
        message = Image(height=600, width=800, encoding="bgr8", step=2400, data=data)
        message.header.frame_id = str(seq)
        publisher.publish(message)
    cpu = 1e3 * (time.process_time() - used) / frames
    rate = frames / (time.perf_counter() - start - WARM_UP_FRAMES / RATE_HZ)
    print(json.dumps([cpu, rate]), flush=True)
    # Readers may still fetch the last ones.
    time.sleep(2.0)


def read(sensor: str, frames: int) -> None:
    """Take pictures; prints the CPU time per picture, ms, and how many there were."""
    node = rclpy.create_node("reader")
    used, count, last, heard = 0.0, 0, -1, math.inf

    def receive(message: Image) -> None:
        nonlocal used, count, last, heard
        heard = time.monotonic()
        last = int(message.header.frame_id)
        if last < WARM_UP_FRAMES:
            used = time.process_time()
        elif last < WARM_UP_FRAMES + frames:
            picture = np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
            count += picture.shape == (600, 800, 3)

    node.create_subscription(Image, f"/lab{sensor}/image", receive, QUEUE_DEPTH)
    while last < WARM_UP_FRAMES + frames - 1 and time.monotonic() < heard + SILENCE_S:
        rclpy.spin_once(node, timeout_sec=1.0)
    print(json.dumps([1e3 * (time.process_time() - used) / max(count, 1), count]), flush=True)


if __name__ == "__main__":
    rclpy.init()
    role, number, *rest = sys.argv[1:]
    write(number, *map(int, rest)) if role == "write" else read(number, *map(int, rest))
    rclpy.shutdown()
