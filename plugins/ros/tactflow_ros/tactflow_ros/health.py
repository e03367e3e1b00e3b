"""How well a sensor works, as a status of /diagnostics."""

from __future__ import annotations

import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from tactflow_ros.messages import MIN_UNIX_TIME_S, Message

MAX_BAD_SHARE = 0.5
"""Share of lost markers, or of damaged pictures, above which /diagnostics warns. Chosen by hand."""


class Health:
    """Statistics of the messages since the last report, and of the gel that they show.

    Attributes
    ----------
    frames : number so far.
    """

    def __init__(self) -> None:
        self.frames = self._missing = self._damaged = self._references = 0
        self._began = self._last = time.monotonic()
        self._latency_s = self._lost_markers = math.nan
        self._seq: int | None = None
        self._reported = (self._began, 0, 0, 0)

    @property
    def age(self) -> float:
        """Time since the last message, or since the start, s."""
        return time.monotonic() - self._last

    def note(self, message: Message) -> None:
        """Count a message."""
        status = (message["markers"] or {}).get("status") or []
        skipped = message.get("skipped") or {}
        seq, t = message["seq"], message["t"]
        self._missing += 0 if self._seq is None else max(0, seq - self._seq - 1)
        self._seq = seq
        self._latency_s = time.time() - t if t > MIN_UNIX_TIME_S else math.nan
        self._lost_markers = status.count("lost") / len(status) if status else math.nan
        self._damaged += "damaged" in skipped.values()
        self._references += "reference" in skipped
        self.frames += 1
        self._last = time.monotonic()

    def report(self, run: Message) -> tuple[bytes, str, dict[str, float]]:
        """The level, why, and the numbers. run : statistics of the run, empty if unknown."""
        since, *before = self._reported
        self._reported = (time.monotonic(), self.frames, self._missing, self._damaged)
        frames, missing, damaged = (new - old for new, old in zip(self._reported[1:], before, strict=True))
        latency = (run.get("latency_ms") or {}).get("p99")
        damaged_share = damaged / frames if frames else math.nan
        numbers = {
            "rate, Hz": frames / max(self._reported[0] - since, 1e-9),
            "age of the last message, s": self.age,
            "frames missing": missing,
            "latency since capture, ms": self._latency_s * 1e3,
            "lost markers, share": self._lost_markers,
            "damaged pictures, share": damaged_share,
            "new references so far": self._references,
            "frames dropped by the run": run.get("dropped", math.nan),
            "latency of the run, p99, ms": math.nan if latency is None else latency,
        }
        if self._lost_markers > MAX_BAD_SHARE:
            return DiagnosticStatus.WARN, "most markers are lost: take a new reference", numbers
        if damaged_share > MAX_BAD_SHARE:
            return DiagnosticStatus.WARN, "most pictures are damaged: check the camera and its cable", numbers
        return DiagnosticStatus.OK, "receiving", numbers


def diagnostics(status: tuple[bytes, str, dict[str, float]], sensor: str, endpoint: str) -> DiagnosticArray:
    """A message for /diagnostics with the status of one sensor, and the address of its results."""
    level, words, numbers = status
    values: Any = [KeyValue(key=key, value=f"{value:.6g}") for key, value in numbers.items()]
    found = DiagnosticStatus(
        level=level, name=f"tactflow: {sensor}", message=words, hardware_id=endpoint, values=values
    )
    return DiagnosticArray(status=[found])
