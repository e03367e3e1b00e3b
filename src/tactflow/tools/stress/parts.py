"""What a part of the stress test returns, and the promises that it checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final


@dataclass(frozen=True, slots=True)
class Promise:
    """A promise to users.

    Attributes
    ----------
    title : the promise, a sentence.
    tolerance : the largest value that keeps it.
    unit : of it, "" for counts.
    why : where the tolerance comes from.
    """

    title: str
    tolerance: float
    unit: str
    why: str


_STATED: Final = "what a result may differ by before a frame is worked on again"

PROMISES: Final[Mapping[str, Promise]] = {
    "arithmetic_dots": Promise(
        "float32 and compiled loops move a dot by less than", 1e-3, "px",
        "a third of the smallest error that noise allows (Cramér-Rao, 0.0034 px)",
    ),
    "arithmetic_center": Promise(
        "float32 and compiled loops move the centre by less than", 0.01, "px",
        "a tenth of the smallest error of a centre on the simulator",
    ),
    "arithmetic_angle": Promise(
        "float32 and compiled loops turn the direction by less than", 0.01, "deg",
        "a seventh of the mean error of a direction on the simulator",
    ),
    "arithmetic_flow": Promise(
        "float32 and compiled loops change the mean flow by less than", 0.01, "px",
        "a tenth of the mean error of the flow on the simulator",
    ),
    "arithmetic_decision": Promise(
        "float32 and compiled loops change no decision", 0, "frames",
        "a decision is not a matter of rounding",
    ),
    "undefined": Promise(
        "every number is finite and of the declared type", 0, "answers", "the message has no NaN or infinity",
    ),
    "exceptions": Promise(
        "no picture ends in an exception or a warning; one that cannot be used is refused in words", 0,
        "answers", "no user mistake ends in a traceback",
    ),
    "disc": Promise(
        "a disc has no direction", 0, "answers", "a direction that the shape does not have is null"
    ),
    "line": Promise("a line has its direction within", 0.5, "deg", "half a pixel over 57 px"),
    "rest": Promise("the reference itself shows no contact", 0, "answers", "nothing has changed"),
    "pixel_dots": Promise("one grey level in one pixel moves a dot by less than", 0.05, "px", _STATED),
    "pixel_center": Promise("one grey level in one pixel moves the centre by less than", 0.5, "px", _STATED),
    "pixel_flow": Promise("one grey level in one pixel changes the flow by less than", 0.05, "px", _STATED),
    "pixel_decision": Promise(
        "one grey level in one pixel changes no decision", 0, "frames", "a false alarm in a million frames",
    ),
    "turn_dots": Promise(
        "turned, mirrored and shifted pictures have the same dots within", 0.05, "px", _STATED
    ),
    "turn_center": Promise(
        "turned, mirrored and shifted pictures have the same centre within", 0.5, "px", _STATED
    ),
    "turn_angle": Promise(
        "turned, mirrored and shifted pictures have the same direction within", 1.0, "deg",
        "the angle of 0.5 px at the end of a contact 57 px long",
    ),
    "turn_flow_stated": Promise(
        "turned, mirrored and shifted pictures have the same flow within", 1.0, "stated errors",
        "an error that is stated covers what does not matter; at least 0.05 px",
    ),
    "turn_decision": Promise(
        "turned, mirrored and shifted pictures have the same decisions", 0, "frames", "the gel is the same",
    ),
    "false_at_rest": Promise(
        "a long rest under slow light has false contacts in fewer frames than", 1e-3, "",
        "a thousand times the false alarms of white noise",
    ),
    "held": Promise(
        "a contact that stays is missed in fewer frames than", 1e-3, "", "a contact that is held is a contact"
    ),
    "dots_drift": Promise("dots at rest drift by less than", 0.05, "px", _STATED),
    "center_drift": Promise("a contact that stays keeps its centre within", 0.5, "px", _STATED),
    "area_drift": Promise(
        "a contact that stays keeps its area within", 10, "%", "0.5 px on each side of a contact of 20 px",
    ),
    "memory": Promise("memory grows by less than", 16, "MB", "one block of the allocator of each thread"),
    "same_bits": Promise(
        "threads, segments and sinks change no bit of a result", 0, "results",
        "an observer never changes values",
    ),
    "skipping_dots": Promise("skipping moves a dot by less than", 0.05, "px", _STATED),
    "skipping_center": Promise("skipping moves the centre by less than", 0.5, "px", _STATED),
    "skipping_flow": Promise("skipping changes the flow by less than", 0.05, "px", _STATED),
    "skipping_decision": Promise(
        "skipping delays no decision by more than a frame", 0, "frames", "an observer never changes values"
    ),
    "other_dots": Promise(
        "other versions of OpenCV move a dot by less than", 0.05, "px", _STATED,
    ),
    "other_center": Promise("other versions of OpenCV move the centre by less than", 0.5, "px", _STATED),
    "other_angle": Promise(
        "other versions of OpenCV turn the direction by less than", 1.0, "deg",
        "the angle of 0.5 px at the end of a contact 57 px long",
    ),
    "other_flow": Promise("other versions of OpenCV change the flow by less than", 0.05, "px", _STATED),
    "other_decision": Promise(
        "other versions of OpenCV change no decision", 0, "frames", "the gel is the same"
    ),
}  # fmt: skip
"""Key -> promise."""


@dataclass(frozen=True, slots=True)
class Check:
    """A promise, measured.

    Attributes
    ----------
    promise : key of `PROMISES`.
    subject : pipeline or stage.
    measured : the worst value.
    where : it was found.
    reference : for the classic script, which keeps the seed's meaning: listed, but not counted as broken.
    """

    promise: str
    subject: str
    measured: float
    where: str = ""
    reference: bool = False

    @property
    def kept(self) -> bool:
        """Whether the promise is kept."""
        return self.measured <= PROMISES[self.promise].tolerance

    @property
    def excess(self) -> float:
        """The measured value in tolerances; infinite where none is tolerated."""
        tolerance = PROMISES[self.promise].tolerance
        return self.measured / tolerance if tolerance else (math.inf if self.measured else 0.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """An error against the strength of a perturbation.

    Attributes
    ----------
    panel : name of the perturbation.
    unit : of its levels.
    quantity : key of the bench's quantities.
    subject : pipeline, on a scene.
    levels : increasing, the first is without perturbation.
    errors : for each; None where there is none.
    bound : smallest standard error of an unbiased method at each level, or None.
    """

    panel: str
    unit: str
    quantity: str
    subject: str
    levels: Sequence[float]
    errors: Sequence[float | None]
    bound: Sequence[float] | None = None


@dataclass(frozen=True, slots=True)
class Listing:
    """A table.

    Attributes
    ----------
    folded : the page shows it on request only; the terminal does not show it.
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    text: str = ""
    folded: bool = False


@dataclass(slots=True)
class Part:
    """One kind of stress: what was done and what came out.

    Attributes
    ----------
    trials : how often something was computed.
    """

    title: str
    text: str
    trials: int = 0
    checks: list[Check] = field(default_factory=list[Check])
    listings: list[Listing] = field(default_factory=list[Listing])
    curves: list[Curve] = field(default_factory=list[Curve])
    seconds: float = 0.0


class Worst:
    """Keeps the worst value of each promise for a subject, and where it was found."""

    def __init__(self, subject: str, *, reference: bool = False) -> None:
        self._subject, self._reference = subject, reference
        self._found: dict[str, tuple[float, str]] = {}

    def add(self, promise: str, value: float, where: str, *, count: bool = False) -> None:
        """Note a value. count : values are added up, and the first place is kept."""
        before, place = self._found.get(promise, (0.0, where))
        if count:
            self._found[promise] = (before + value, place if before else where)
        elif promise not in self._found or value > before:
            self._found[promise] = (value, where)

    def value(self, promise: str) -> float | None:
        """The worst value of a promise; None where it was never checked."""
        return self._found[promise][0] if promise in self._found else None

    def checks(self) -> list[Check]:
        """One check for each promise."""
        return [
            Check(promise, self._subject, value, where if value else "", self._reference)
            for promise, (value, where) in self._found.items()
        ]
