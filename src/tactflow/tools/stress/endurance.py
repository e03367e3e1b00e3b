"""Long runs: hundreds of thousands of frames at rest and in contact, and what drifts.

A recording starts at rest under light that changes slowly, then holds a contact whose light creeps back while
the dots stay, and ends at rest.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.message.result import Result
from tactflow.tools.stress.inputs import gel
from tactflow.tools.stress.parts import Curve, Listing, Part, Worst
from tactflow.tools.stress.subjects import Subject

Image = NDArray[np.uint8]

FRAMES: Final = 200_000
"""Frames of a full run: an hour of a camera at 60 Hz. A million take twenty minutes for each pipeline."""
QUICK_FRAMES: Final = 1_000
CLASSIC_SHARE: Final = 100
"""The script gets so many times fewer frames, since each takes so much longer."""
TOUCHED_FROM, TOUCHED_TO = 0.6, 0.75
"""Part of the recording in which the gel is touched."""
SLOW_LIGHT: Final = 0.08
"""Amplitude of the slow change of the light, relative: that of lamps while they warm up and of daylight."""
CREEP: Final = 0.25
"""Share of its change that the light of a held contact loses: as a gel relaxes under load."""
VARIANTS: Final = 61
"""Frames with different noise; a prime number, so that no period of a stage falls together with theirs."""
WINDOWS: Final = 20
"""Parts of the recording that are compared with each other."""
STEPS: Final = 16
"""Steps in which a contact creeps."""


def frames(count: int, *, dots: bool, seed: int = 1) -> Iterator[Image]:
    """The recording, frame by frame."""
    pictures = gel(dots=dots, noise=0.0)
    random = np.random.default_rng(seed)
    noises = random.normal(0, 1, (VARIANTS, *pictures.reference.shape)).astype(np.float32)
    change = pictures.touched.astype(np.float32) - pictures.reference

    def noisy(picture: NDArray[np.float32], variants: int) -> list[Image]:
        return [np.clip(np.rint(picture + noise), 0, 255).astype(np.uint8) for noise in noises[:variants]]

    rest = noisy(pictures.reference.astype(np.float32), VARIANTS)
    # The dots stay where they are; only the light of the contact creeps.
    held = [
        noisy(pictures.reference + change * np.float32(1 - CREEP * step / (STEPS - 1)), VARIANTS // 4)
        for step in range(STEPS)
    ]
    first, last = int(TOUCHED_FROM * count), int(TOUCHED_TO * count)
    for index in range(count):
        light = 1 + SLOW_LIGHT * np.sin(2 * np.pi * index / count)
        pool = rest if not first <= index < last else held[(index - first) * STEPS // max(1, last - first)]
        yield cv2.convertScaleAbs(pool[index % len(pool)], alpha=light).astype(np.uint8)


def memory_mb() -> float:
    """Memory of this process, MB: resident now, or its peak where that is not told; NaN on Windows."""
    if sys.platform == "win32":
        return float("nan")
    statm = Path("/proc/self/statm")
    if statm.exists():
        return float(int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20)
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return float(peak / (2**20 if sys.platform == "darwin" else 2**10))


@dataclass(slots=True)
class Window:
    """Means over a part of the recording; lists of single frames would grow, and count as memory.

    Attributes
    ----------
    frames, contacts, seen : their numbers, and that of the frames at rest with dots.
    dots : mean displacement of the dots at rest, px.
    center, area : means of the contacts, px, px^2.
    memory : MB.
    """

    frames: int = 0
    contacts: int = 0
    seen: int = 0
    dots: float = 0.0
    center: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    area: float = 0.0
    memory: float = 0.0

    def add(self, result: Result) -> None:
        """Add a frame."""
        self.frames += 1
        if result.contact is not None:
            self.contacts += 1
            self.center += (np.array(result.contact.center) - self.center) / self.contacts
            self.area += (result.contact.area - self.area) / self.contacts
        elif result.markers is not None:
            seen = result.markers.status == 0
            if seen.any():
                self.seen += 1
                moved = float(np.abs(result.markers.displacement[seen].mean(axis=0)).max())
                self.dots += (moved - self.dots) / self.seen


def run_endurance(subjects: Sequence[Subject], *, quick: bool, length: int | None = None) -> Part:
    """Every pipeline on a long recording. length : frames; None: those of a full or a quick run."""
    count = length or (QUICK_FRAMES if quick else FRAMES)
    part = Part(
        "Long run",
        f"{count:,} frames of 176 x 128 px: at rest, the light changes by {100 * SLOW_LIGHT:.0f} %, "
        f"then a contact whose light creeps back by {100 * CREEP:.0f} % while its dots stay, then rest.",
    )
    rows = []
    for subject in subjects:
        share = count // CLASSIC_SHARE if subject.reference else count
        windows = _run(subject, max(share, WINDOWS * 10))
        part.trials += sum(window.frames for window in windows)
        worst = Worst(subject.name, reference=subject.reference)
        rows.append([subject.name, *_judge(worst, windows)])
        part.checks += worst.checks()
        levels = [(number + 1) / WINDOWS for number in range(WINDOWS)]
        for name, values in (
            ("memory_mb", [window.memory for window in windows]),
            ("dots_drift", [w.dots if w.seen else None for w in windows]),
        ):
            if any(value is not None for value in values):
                part.curves.append(Curve("long run", "share of the run", name, subject.name, levels, values))
    columns = ["pipeline", "frames", "false contacts at rest", "contacts missed", "dots drift, px"]
    columns += ["centre drifts, px", "area drifts, %", "memory at first, MB", "at the end, MB"]
    part.listings.append(Listing("Drift from the first to the last part", columns, rows))
    return part


def _run(subject: Subject, count: int) -> list[Window]:
    windows = [Window() for _ in range(WINDOWS)]
    pipeline = subject.load(frames(count, dots=subject.dots))
    for result in tactflow.stream(pipeline):
        window = windows[result.seq * WINDOWS // count]
        window.add(result)
        if window.frames == 1 or result.seq == count - 1:
            window.memory = memory_mb()
    return windows


def _judge(worst: Worst, windows: Sequence[Window]) -> list[str]:
    """Check the promises; returns the cells of a row."""
    count = sum(window.frames for window in windows)
    first, last = round(TOUCHED_FROM * WINDOWS), round(TOUCHED_TO * WINDOWS)
    held, rest = windows[first:last], [*windows[:first], *windows[last:]]
    false = sum(window.contacts for window in rest) / max(1, sum(window.frames for window in rest))
    missed = 1 - sum(window.contacts for window in held) / max(1, sum(window.frames for window in held))
    worst.add("false_at_rest", false, "at rest")
    worst.add("held", missed, "in contact")
    dots = [window.dots for window in rest if window.seen]
    drift = abs(dots[-1] - dots[0]) if dots else None
    cells = [f"{count:,}", f"{false:.2g}", f"{missed:.2g}", "-" if drift is None else f"{drift:.2g}"]
    if drift is not None:
        worst.add("dots_drift", drift, "at rest")
    centers = [window.center for window in held if window.contacts]
    areas = [window.area for window in held if window.contacts]
    if centers:
        shift = max(float(np.hypot(*(center - centers[0]))) for center in centers)
        growth = max(100 * abs(area / areas[0] - 1) for area in areas)
        worst.add("center_drift", shift, "in contact")
        worst.add("area_drift", growth, "in contact")
        cells += [f"{shift:.2g}", f"{growth:.2g}"]
    else:
        cells += ["-", "-"]
    # What is allocated once is there after a tenth of the run.
    early, late = windows[WINDOWS // 10].memory, windows[-1].memory
    worst.add("memory", late - early, "at the end")
    return [*cells, f"{early:.0f}", f"{late:.0f}"]
