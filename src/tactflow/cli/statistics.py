"""The statistics file that `tactflow run --stats` writes, read again, and its numbers in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ValidationError

from tactflow.engine.errors import ConfigError

_FAILURES = ("error", "disabled")
"""Reasons for not running that are failures: what they left out is not saved."""

_WORDS = {"no_demand": "not wanted"}


class NodeStatistics(BaseModel):
    """What one stage or sink did in a run.

    runs : frames it ran on. skips : reason -> frames it did not run on. total_ms : time of all runs.
    p50_ms, p99_ms : time of a run; None where unknown.
    """

    runs: int
    skips: dict[str, int]
    total_ms: float | None = None
    p50_ms: float | None
    p99_ms: float | None

    @property
    def frames(self) -> int:
        """Frames that reached it."""
        return self.runs + sum(self.skips.values())

    @property
    def mean_ms(self) -> float | None:
        """Mean time of a run."""
        return self.total_ms / self.runs if self.runs and self.total_ms is not None else None

    @property
    def skipped(self) -> int:
        """Frames that it could skip; those on which it failed do not count."""
        return sum(count for reason, count in self.skips.items() if reason not in _FAILURES)

    @property
    def saved_ms(self) -> float:
        """Time that skipping saved: frames skipped x mean time of a run."""
        return self.skipped * (self.mean_ms or 0.0)

    @property
    def spent_ms(self) -> float:
        """Time of all runs; 0 where unknown."""
        return self.total_ms or 0.0 if self.runs else 0.0

    def reasons(self) -> list[str]:
        """Each reason for not running with its share, the most frequent first."""
        ordered = sorted(self.skips.items(), key=lambda item: -item[1])
        return [
            f"{share(count, self.frames)} {_WORDS.get(reason, reason.replace('_', ' '))}"
            for reason, count in ordered
            if count
        ]

    def __str__(self) -> str:
        """How often it ran and why not, time of a run, and what skipping saved per frame."""
        if not self.frames:
            return "never reached by a frame"
        reasons = self.reasons()
        parts = [
            f"ran {share(self.runs, self.frames)}" + (f", skipped {', '.join(reasons)}" if reasons else "")
        ]
        if self.p50_ms is not None:
            mean = "" if self.mean_ms is None else f"mean {milliseconds(self.mean_ms)}, "
            parts.append(f"a run: {mean}p50 {milliseconds(self.p50_ms)}, p99 {milliseconds(self.p99_ms)}")
        if self.skipped and self.mean_ms is not None:
            parts.append(saving(self.saved_ms, self.saved_ms + self.spent_ms, self.frames))
        elif self.skipped and not self.runs:
            parts.append("saved: unknown, as it never ran")
        return "; ".join(parts)


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
    sinks: dict[str, NodeStatistics] = {}
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

    @property
    def nodes(self) -> Mapping[str, NodeStatistics]:
        """Id of a stage or sink -> its statistics."""
        return {**self.sinks, **self.stages}


def share(part: int, whole: int) -> str:
    """A share in percent; 0 % and 100 % only where that is exact.

    >>> share(1, 1000), share(0, 7), share(999, 1000)
    ('<1 %', '0 %', '>99 %')
    """
    percent = 100 * part / whole if whole > 0 else 0
    if 0 < percent < 1:
        return "<1 %"
    return ">99 %" if 99 < percent < 100 else f"{percent:.0f} %"


def saving(saved_ms: float, all_ms: float, frames: int) -> str:
    """`saved 38.0 ms of 41.0 ms a frame`."""
    return f"saved {milliseconds(saved_ms / frames)} of {milliseconds(all_ms / frames)} a frame"


def milliseconds(value: float | None) -> str:
    """A time with three digits.

    >>> milliseconds(0.25), milliseconds(12.3456)
    ('0.250 ms', '12.3 ms')
    """
    if value is None:
        return "unknown"
    return f"{value:.{3 if value < 1 else 2 if value < 10 else 1}f} ms"
