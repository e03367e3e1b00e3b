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
        text = f"ran {100 * self.runs / frames:.3g} %"
        skips = sorted(((n, reason) for reason, n in self.skips.items() if n), reverse=True)
        reasons = [f"{100 * n / frames:.3g} % {reason.replace('_', ' ')}" for n, reason in skips]
        if reasons:
            text += f", skipped {', '.join(reasons)}"
        if not self.runs or self.p50_ms is None or self.p99_ms is None:
            return text
        mean = self.total_ms / self.runs
        text += f"; a run: mean {mean:.3g} ms, p50 {self.p50_ms:.3g} ms, p99 {self.p99_ms:.3g} ms"
        saved = mean * sum(n for n, reason in skips if reason not in _FAILURES)
        if saved:
            text += f"; saved {saved / frames:.3g} ms of {(saved + self.total_ms) / frames:.3g} ms a frame"
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
