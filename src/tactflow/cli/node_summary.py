"""Statistics of one stage or sink in words: how often it ran, why not, and what skipping saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_NOT_SAVED = ("error", "disabled")
"""Reasons that are failures: what they left out is no gain."""

_WORDS = {"no_demand": "not wanted"}


def share(part: int, whole: int) -> str:
    """A share in percent; never 0 % or 100 % for what is only nearly so."""
    if whole <= 0:
        return "0 %"
    percent = 100 * part / whole
    if 0 < percent < 1:
        return "<1 %"
    if 99 < percent < 100:
        return ">99 %"
    return f"{percent:.0f} %"


@dataclass(frozen=True, slots=True)
class NodeSummary:
    """What one stage or sink did in a run.

    ticks : frames that reached it. runs : of these, those it ran on. skips : reason -> frames.
    mean_ms, p50_ms, p99_ms : time of a run; None where unknown.
    """

    ticks: int
    runs: int
    skips: Mapping[str, int]
    mean_ms: float | None
    p50_ms: float | None
    p99_ms: float | None

    @classmethod
    def of(cls, entry: Mapping[str, Any]) -> NodeSummary:
        """From the entry of a statistics file."""
        skips = {reason: count for reason, count in entry["skips"].items() if count}
        runs, total = entry["runs"], entry.get("total_ms")
        mean = total / runs if runs and total is not None else None
        return cls(runs + sum(skips.values()), runs, skips, mean, entry["p50_ms"], entry["p99_ms"])

    @property
    def skipped(self) -> int:
        """Frames that it could leave out; those that failed do not count."""
        return sum(count for reason, count in self.skips.items() if reason not in _NOT_SAVED)

    @property
    def saved_ms(self) -> float | None:
        """What skipping saved over the run: frames left out x mean time of a run. None if it never ran."""
        return None if self.mean_ms is None else self.skipped * self.mean_ms

    @property
    def spent_ms(self) -> float:
        """What its runs took."""
        return 0.0 if self.mean_ms is None else self.runs * self.mean_ms

    def shares(self) -> str:
        """How often it ran and why not: `ran 12 %, skipped 71 % no contact, 17 % unchanged`."""
        if not self.ticks:
            return "never reached by a frame"
        text = f"ran {share(self.runs, self.ticks)}"
        if self.skips:
            text += ", skipped " + ", ".join(self.reasons())
        return text

    def reasons(self) -> list[str]:
        """Each reason for not running with its share, the commonest first."""
        ordered = sorted(self.skips.items(), key=lambda item: -item[1])
        return [
            f"{share(count, self.ticks)} {_WORDS.get(reason, reason.replace('_', ' '))}"
            for reason, count in ordered
        ]

    def told(self) -> str:
        """Shares, time of a run, and what was saved of what all frames would have cost, per frame."""
        parts = [self.shares()]
        if self.mean_ms is not None:
            parts.append(
                f"a run: mean {milliseconds(self.mean_ms)}, p50 {milliseconds(self.p50_ms)}, "
                f"p99 {milliseconds(self.p99_ms)}"
            )
        elif self.p50_ms is not None:
            parts.append(f"a run: p50 {milliseconds(self.p50_ms)}, p99 {milliseconds(self.p99_ms)}")
        if self.skipped and self.saved_ms is not None:
            parts.append(saving(self.saved_ms, self.saved_ms + self.spent_ms, self.ticks))
        elif self.skipped and not self.runs:
            parts.append("saved: unknown, as it never ran")
        return "; ".join(parts)


def saving(saved_ms: float, all_ms: float, frames: int) -> str:
    """`saved 38 ms of 41 ms a frame`."""
    return f"saved {milliseconds(saved_ms / frames)} of {milliseconds(all_ms / frames)} a frame"


def milliseconds(value: float | None) -> str:
    """A time with three digits."""
    if value is None:
        return "unknown"
    return f"{value:.3f} ms" if value < 1 else f"{value:.2f} ms" if value < 10 else f"{value:.1f} ms"
