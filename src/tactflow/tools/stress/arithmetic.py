"""Arithmetic: float32 and loops in C against float64 and NumPy.

Each loop has a version in NumPy, which is given float64 where that in C gets float32. Everything else of the
pipeline stays as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from tactflow.tools.bench.scenes import FULL, QUICK, TROUBLES, Case
from tactflow.tools.stress.clips import clip
from tactflow.tools.stress.compare import add_differences, cells, heads, numbers
from tactflow.tools.stress.parts import Listing, Part, Worst
from tactflow.tools.stress.subjects import Subject
from tactflow.vision import compiled

STEP_FRAMES = 4
"""Every fourth frame of a scene."""
MAX_FRAMES = 60
"""Longest part of a scene, frames."""


def run_arithmetic(subjects: Sequence[Subject], *, quick: bool) -> Part:
    """Every pipeline on all scenes, in both arithmetics."""
    part = Part(
        "Arithmetic",
        "Loops in C with float32 and sums in any order, against the same loops in NumPy with float64: the "
        "largest difference of each number over all frames of all scenes.",
    )
    cases = [Case(c.name, min(c.frames, MAX_FRAMES), c.query, c.suffix) for c in (*FULL, *TROUBLES)]
    rows = []
    for subject in [subject for subject in subjects if not subject.reference]:
        worst = Worst(subject.name)
        largest: dict[str, float] = {}
        for case in QUICK[:1] if quick else cases:
            plain = clip(case, STEP_FRAMES)
            if bool(len(plain.scene.layout.rest)) != subject.dots:
                continue
            fast = [numbers(result) for result in subject.run(plain.frames)]
            with strict():
                slow = [numbers(result) for result in subject.run(plain.frames)]
            found = add_differences(worst, "arithmetic", list(zip(fast, slow, strict=True)), case.label)
            largest |= {key: max(largest.get(key, 0.0), value) for key, value in found.items()}
            part.trials += 2 * len(fast)
        rows.append([subject.name, *cells(largest)])
        part.checks += worst.checks()
    part.listings.append(Listing("Largest differences", ["pipeline", *heads()], rows))
    return part


@contextmanager
def strict() -> Iterator[None]:
    """Within the block all loops run in NumPy and float64."""
    loops = compiled.kernels()
    before = [loop.compiled for loop in loops]
    try:
        for loop in loops:
            loop.compiled = _wide(loop)
        yield
    finally:
        for loop, one in zip(loops, before, strict=True):
            loop.compiled = one


def _wide(loop: compiled.Kernel[..., Any]) -> Callable[..., Any]:
    """The loop in NumPy, as a function that gives it float64."""

    def call(*args: Any) -> Any:
        wide = [_widened(value) for value in args]
        with np.errstate(all="ignore"):
            result = loop.plain(*wide)
        for value, copy in zip(args, wide, strict=True):
            if isinstance(value, np.ndarray) and copy is not value and value.flags.writeable:
                value[...] = copy
        return result

    return call


def _widened(value: Any) -> Any:
    if isinstance(value, np.float32):
        return np.float64(value)
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype == np.float32:
        # What is not yet filled may look like a signalling NaN.
        with np.errstate(invalid="ignore"):
            return value.astype(np.float64)
    return value if value.flags.writeable else value.copy()
