"""The statistics file that `tactflow run --stats` writes, read again, and its numbers in words."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ValidationError

from tactflow.engine.errors import ConfigError

_FAILURES = ("error", "disabled")
"""Reasons for not running that are failures, which save no time."""


class NodeStatistics(BaseModel):
    """What one stage or sink did in a run.

    runs : frames it ran on. skips : reason -> frames it did not run on. total_ms : time of all runs.
    p50_ms, p99_ms : time of a run; None without one.
    """

    runs: int
    skips: dict[str, int]
    total_ms: float
    p50_ms: float | None
    p99_ms: float | None

    def __str__(self) -> str:
        """How often it ran and why not, time of a run, and what skipping saved per frame."""
        frames = self.runs + sum(self.skips.values())
        if not frames:
            return "never reached by a frame"
        text = f"ran {share(self.runs, frames)}"
        skips = sorted(self.skips.items(), key=lambda item: -item[1])
        reasons = [f"{share(count, frames)} {reason.replace('_', ' ')}" for reason, count in skips if count]
        if reasons:
            text += f", skipped {', '.join(reasons)}"
        if not self.runs:
            return text
        mean = self.total_ms / self.runs
        p50, p99 = milliseconds(self.p50_ms), milliseconds(self.p99_ms)
        text += f"; a run: mean {milliseconds(mean)}, p50 {p50}, p99 {p99}"
        saved = mean * sum(count for reason, count in skips if reason not in _FAILURES)
        if saved:
            of = milliseconds((saved + self.total_ms) / frames)
            text += f"; saved {milliseconds(saved / frames)} of {of} a frame"
        return text


class Latency(BaseModel):
    """Time from capture to the end of the last stage, ms; None where unknown."""

    p50: float | None
    p99: float | None


class Statistics(BaseModel):
    """What a run did, and how long it took."""

    frames: int
    dropped: int
    wall_s: float
    end: str
    stages: dict[str, NodeStatistics]
    sinks: dict[str, NodeStatistics]
    latency_ms: Latency

    @classmethod
    def read(cls, path: Path) -> Statistics:
        """Read a statistics file; raises ConfigError if it cannot be read, or is not one."""
        try:
            return cls.model_validate_json(path.read_bytes())
        except OSError as error:
            raise ConfigError(f"--stats {path}: cannot be read: {error.strerror}") from None
        except ValidationError:
            raise ConfigError(
                f"--stats {path}: not a statistics file; tactflow run --stats writes one"
            ) from None


def share(part: int, whole: int) -> str:
    """A share in percent; 0 % and 100 % only where that is exact.

    >>> share(1, 1000), share(0, 7), share(999, 1000)
    ('<1 %', '0 %', '>99 %')
    """
    percent = 100 * part / whole if whole > 0 else 0
    if 0 < percent < 1:
        return "<1 %"
    return ">99 %" if 99 < percent < 100 else f"{percent:.0f} %"


def milliseconds(value: float | None) -> str:
    """A time with three digits.

    >>> milliseconds(0.25), milliseconds(12.3456)
    ('0.250 ms', '12.3 ms')
    """
    if value is None:
        return "unknown"
    return f"{value:.{3 if value < 1 else 2 if value < 10 else 1}f} ms"
