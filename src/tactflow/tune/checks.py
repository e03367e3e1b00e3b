"""What a recording without labels says of a pipeline: does it agree with itself, and with the dearest one?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.bench.timing import CopyUnit, Times
from tactflow.doctor.checks import STEADY
from tactflow.engine.graph import Pipeline
from tactflow.tune.recording import HEAD, Recording
from tactflow.vision.types import MarkerStatus

WORDS: Final = {
    "backward": "dots, forward against backward in time, RMS px",
    "odd_even": "dots, all frames against every second, RMS px",
    "return": "dots, displacement at rest after contacts, RMS px",
    "idle_contacts": "idle frames called contact, %",
    "distance": "centre, distance from the most expensive, median px",
    "agreement": "contact or not, as the most expensive says, %",
}
"""Check -> how it is told."""


@dataclass
class _Seen:
    """What a pipeline said, by frame of the recording; positions in px of the camera's picture."""

    centers: dict[int, NDArray[np.float64] | None] = field(default_factory=dict)
    dots: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = field(default_factory=dict)

    def add(self, number: int, outcome: TimedResult) -> str:
        """Keep one frame's answers; returns the kind of frame."""
        mapping = outcome.mapping
        to_raw = np.asarray if mapping is None else mapping.to_raw
        contact = outcome.contact
        self.centers[number] = None if contact is None else to_raw(np.array(contact.center, np.float64))
        if outcome.markers is not None and len(outcome.markers.position):
            markers = outcome.markers
            position = np.array(to_raw(np.asarray(markers.position, np.float64)), np.float64)
            position[markers.status != MarkerStatus.TRACKED] = np.nan
            origin = np.array(to_raw(np.asarray(markers.origin, np.float64)), np.float64)
            self.dots[number] = origin, position
        return "idle" if contact is None else "contact"


def orders(frames: int) -> dict[str, list[int]]:
    """The orders in which a recording is shown; each begins with the frames of the reference.

    >>> orders(12)["backward"]
    [0, 1, 2, 3, 4, 5, 6, 7, 11, 10, 9, 8]
    """
    head, rest = list(range(min(HEAD, frames))), list(range(min(HEAD, frames), frames))
    return {"forward": head + rest, "backward": head + rest[::-1], "odd_even": head + rest[::2]}


def run(
    pipelines: Mapping[str, Pipeline],
    recording: Recording,
    folder: Path,
    unit: CopyUnit,
    late: Callable[[], bool] = lambda: False,
) -> tuple[dict[str, dict[str, float]], dict[str, Times], dict[str, str]]:
    """Show the recording to pipelines in several orders.

    Parameters
    ----------
    pipelines : name -> pipeline; the first is the most expensive one, from which distances are taken.
    late : whether it is time to stop; what was shown until then is compared.

    Returns
    -------
    checks : name -> check -> value. times : name -> kind -> samples, of the order of the recording; empty if
    it was not shown to its end.
    failures : name -> why.
    """
    frames = np.load(recording.path, mmap_mode="r")
    seen: dict[str, dict[str, _Seen]] = {name: {} for name in pipelines}
    times: dict[str, Times] = {}
    failures: dict[str, str] = {}
    for order, numbers in orders(recording.frames).items():
        if late():
            break
        path = recording.path if order == "forward" else folder / f"{order}.npy"
        if order != "forward":
            np.save(path, frames[numbers])

        def see(name: str, outcome: TimedResult, order: str = order, numbers: list[int] = numbers) -> str:
            if not 0 <= outcome.frame.seq < len(numbers):
                return "reference"
            return seen[name].setdefault(order, _Seen()).add(numbers[outcome.frame.seq], outcome)

        ready = {n: on_recording(p, path) for n, p in pipelines.items() if n not in failures}
        found, failed = take_turns(ready, see, unit=unit, late=late)
        failures.update(failed)
        if order == "forward":
            whole = any(len(one["forward"].centers) == len(numbers) for one in seen.values() if one)
            times = found if whole else {}
        else:
            path.unlink()
    good = [name for name in pipelines if name not in failures]
    good = [name for name in good if "forward" in seen[name]]
    dearest = seen[good[0]]["forward"] if good else _Seen()
    return {name: _compared(seen[name], dearest) for name in good}, times, failures


def _compared(seen: Mapping[str, _Seen], dearest: _Seen) -> dict[str, float]:
    """The checks of one pipeline."""
    forward = seen["forward"]
    found: dict[str, Any] = {
        order: _apart(forward, seen.get(order, _Seen())) for order in ("backward", "odd_even")
    }
    rest = [number for number in _at_rest(dearest) if number in forward.centers]
    later = [number for number in rest if number >= len(forward.centers) // 2 and number in forward.dots]
    if rest:
        found["idle_contacts"] = 100.0 * float(np.mean([forward.centers[n] is not None for n in rest]))
    if later:
        moved = [np.hypot(*(forward.dots[n][1] - forward.dots[n][0]).T) for n in later]
        found["return"] = float(np.sqrt(np.nanmean(np.concatenate(moved) ** 2)))
    both = [n for n in forward.centers if n in dearest.centers]
    agree = [(forward.centers[n] is None) == (dearest.centers[n] is None) for n in both]
    found["agreement"] = 100.0 * float(np.mean(agree)) if agree else None
    away = [
        float(np.hypot(*(here - there)))
        for n in both
        if (here := forward.centers[n]) is not None and (there := dearest.centers[n]) is not None
    ]
    found["distance"] = float(np.median(away)) if away else None
    return {key: value for key, value in found.items() if value is not None and np.isfinite(value)}


def _apart(one: _Seen, other: _Seen) -> float | None:
    """RMS distance of the same dots in the same frames, px; None where none was followed in both."""
    squares = []
    for number in set(one.dots) & set(other.dots):
        here, there = one.dots[number][1], other.dots[number][1]
        if here.shape == there.shape:
            squares.append(((here - there) ** 2).sum(axis=1))
    together = np.concatenate(squares) if squares else np.zeros(0)
    together = together[np.isfinite(together)]
    return float(np.sqrt(together.mean())) if len(together) else None


def _at_rest(dearest: _Seen) -> list[int]:
    """Frames in which no dot has moved; without dots, nobody can tell without asking the light."""
    rest = []
    for number, (origin, position) in dearest.dots.items():
        moved = np.hypot(*(position - origin).T)
        if np.isfinite(moved).mean() > 0.5 and np.nanpercentile(moved, 95) < STEADY:
            rest.append(number)
    return rest
