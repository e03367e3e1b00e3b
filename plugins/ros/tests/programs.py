"""Programs in an environment of their own, with rclpy and without tactflow, as on a robot."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.clock import PATIENCE
from tests.paths import REPOSITORY

PYTHON = REPOSITORY / ".venv-ros" / "bin" / "python"
PACKAGE = REPOSITORY / "plugins" / "ros" / "tactflow_ros"
LISTENER = Path(__file__).with_name("listener.py")

needs_rclpy = pytest.mark.skipif(not PYTHON.exists(), reason="rclpy is not here: make ros-env")


def environment() -> dict[str, str]:
    """For programs that shall find each other and nobody else."""
    return os.environ | {
        # The stand-in for tf2_msgs is here.
        "PYTHONPATH": os.pathsep.join([str(PACKAGE), str(Path(__file__).parent)]),
        "ROS_DOMAIN_ID": str(os.getpid() % 100),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


class Program:
    """A program that tells, in lines, what it does.

    arguments : of Python. said : every line so far of its results. complaints : of its log.
    """

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [str(PYTHON), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment(),
        )
        self.said: list[str] = []
        self.complaints: list[str] = []
        self._lines: queue.Queue[str] = queue.Queue()
        self._readers = [threading.Thread(target=read) for read in (self._read, self._read_log)]
        for reader in self._readers:
            reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as lines:
            for line in lines:
                self.said.append(line)
                self._lines.put(line)

    def _read_log(self) -> None:
        assert self.process.stderr is not None
        with self.process.stderr as lines:
            self.complaints.extend(iter(lines.readline, ""))

    def told(self, wanted: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """The next JSON object it tells that is wanted; others are passed over."""
        while True:
            line = self._lines.get(timeout=PATIENCE)
            found: dict[str, Any] = json.loads(line)
            if wanted(found):
                return found

    def order(self, **what: Any) -> None:
        """Tell it to do something."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()

    def end(self) -> int:
        """End it as Ctrl-C does; its exit code."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(PATIENCE)
        finally:
            self.process.kill()
            self.process.wait()
            for reader in self._readers:
                reader.join()
