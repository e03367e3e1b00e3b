"""Same answer: what must not change a result, and what a run on another machine or OpenCV gives."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.message.result import Result, encode_message
from tactflow.tools.bench.results import load_stored
from tactflow.tools.stress.clips import cases_for, clip
from tactflow.tools.stress.compare import add_differences, cells, difference, heads, numbers
from tactflow.tools.stress.parts import Listing, Part, Worst
from tactflow.tools.stress.subjects import Subject, in_segments, results

Answers = dict[str, list[dict[str, Any]]]
"""pipeline/scene -> the numbers of each frame."""
Run = Callable[[Subject, Sequence[Any], Path], list[Result]]

QUICK_FRAMES: Final = 8
"""Frames of a scene in a quick run."""
DECIMALS: Final = 5
"""Decimals of stored answers."""


def _sinks(folder: Path, *names: str) -> dict[str, Any]:
    known = {
        "lines": {"use": "jsonl", "path": str(folder / "lines.jsonl"), "overwrite": True},
        "pictures": {"use": "images", "folder": str(folder / "pictures"), "overwrite": True},
    }
    return {name: known[name] for name in names}


def _with_sinks(*names: str) -> Run:
    def run(subject: Subject, frames: Sequence[Any], folder: Path) -> list[Result]:
        return results(subject.load(frames, sinks=_sinks(folder, *names)), sinks=True)

    return run


EXACT_VARIANTS: Final[Mapping[str, Run]] = {
    "once more": lambda subject, frames, _: subject.run(frames),
    "2 threads of OpenCV": lambda subject, frames, _: subject.run(frames, opencv_threads=2),
    "4 threads of OpenCV": lambda subject, frames, _: subject.run(frames, opencv_threads=4),
    "every stage in its segment": lambda subject, frames, _: results(in_segments(subject.load(frames))),
    "sinks: lines, pictures": _with_sinks("lines", "pictures"),
    "sinks: pictures, lines": _with_sinks("pictures", "lines"),
}
"""What must not change a bit -> how to run it."""


def run_same(
    subjects: Sequence[Subject], *, quick: bool, stored: Answers | None = None
) -> tuple[Part, Answers]:
    """Every pipeline, run in other ways; and its answers, for another run.

    stored : answers of a run elsewhere, to compare with.
    """
    part = Part(
        "Same answer",
        "The number of results that differ in any bit of the message or the contact mask; and differences of "
        "the numbers without skipping and, with --against, to a run elsewhere.",
    )
    answers: Answers = {}
    bits: list[list[Any]] = []
    far: list[list[Any]] = []
    ways = dict(list(EXACT_VARIANTS.items())[1::2]) if quick else EXACT_VARIANTS
    for subject in subjects:
        worst = Worst(subject.name, reference=subject.reference)
        for case in cases_for(dots=subject.dots, count=1 if quick else None):
            found = clip(case).frames[: QUICK_FRAMES if quick else None]
            plain = subject.run(found)
            part.trials += len(plain)
            label = f"{subject.name}/{case.label}"
            answers[label] = [numbers(result) for result in plain]
            for name, run in ways.items():
                with tempfile.TemporaryDirectory() as folder:
                    other = run(subject, found, Path(folder))
                part.trials += len(other)
                differing = _differing(plain, other)
                worst.add("same_bits", differing, f"{name}, {case.label}", count=True)
                bits.append([name, case.label, subject.name, differing])
            fresh = [numbers(result) for result in subject.run(found, skipping=False)]
            part.trials += len(fresh)
            far.append(
                ["without skipping", case.label, subject.name, *_skipping(worst, answers[label], fresh)]
            )
            if stored is not None and label in stored:
                pairs = list(zip(stored[label], answers[label], strict=False))
                largest = add_differences(worst, "other", pairs, case.label)
                far.append(["elsewhere", case.label, subject.name, *cells(largest)])
        part.checks += worst.checks()
    part.listings.append(
        Listing("Results that differ in any bit", ["way", "scene", "pipeline", "results"], bits)
    )
    part.listings.append(Listing("Largest differences", ["way", "scene", "pipeline", *heads()], far))
    return part, answers


def _differing(one: Sequence[Result], other: Sequence[Result]) -> int:
    """How many results differ in any bit."""
    if len(one) != len(other):
        return max(len(one), len(other))
    return sum(
        encode_message(a, detail=True) != encode_message(b, detail=True)
        or _bytes(a.contact_mask) != _bytes(b.contact_mask)
        for a, b in zip(one, other, strict=True)
    )


def _bytes(mask: NDArray[np.uint8] | None) -> bytes:
    return b"" if mask is None else mask.tobytes()


def _skipping(worst: Worst, skipping: Sequence[Any], fresh: Sequence[Any]) -> list[str]:
    """Check the promises about skipping, which may be late by a frame; returns the cells of a row."""
    before: set[str] = set()
    largest: dict[str, float] = {}
    for number, (one, other) in enumerate(zip(skipping, fresh, strict=True)):
        found = difference(one, other)
        late = {key for key, value in found.items() if value > LATE_TOLERANCES.get(key, np.inf)}
        for key, value in found.items():
            if key in late and key not in before:
                continue
            counted = key == "decision"
            largest[key] = largest.get(key, 0.0) + value if counted else max(largest.get(key, 0.0), value)
            if f"skipping_{key}" in _SKIPPING:
                worst.add(f"skipping_{key}", value, f"frame {number}", count=counted)
        before = late
    return cells(largest)


LATE_TOLERANCES: Final = {"dots": 0.05, "center": 0.5, "flow": 0.05, "decision": 0.0}
"""Differences that may last for one frame: tolerances of skipping."""
_SKIPPING: Final = frozenset(f"skipping_{key}" for key in LATE_TOLERANCES)


def rounded(answers: Answers) -> Answers:
    """Answers to be stored."""

    def short(value: Any) -> Any:
        return value if isinstance(value, bool) else np.round(value, DECIMALS).tolist()

    return {
        label: [{key: short(value) for key, value in frame.items()} for frame in frames]
        for label, frames in answers.items()
    }


def load_answers(path: Path, schema: str) -> Answers:
    """The answers of a stored run. ConfigError if the file is not a result of `tactflow stress`."""
    answers: Answers = load_stored(path, "stress", schema, "answers")["answers"]
    return answers
