"""The quantities that the bench measures, and how their values from many frames become one number."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Summary = Callable[[NDArray[np.float64]], Any]


def rms(values: NDArray[np.float64]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


P99 = partial(np.percentile, q=99)
"""99th percentile."""
MEAN, MOST = np.mean, np.max
"""How values become one number."""


TOLERANCE_SHARE = 0.1
"""Share of a stored error by which a later one may exceed it: keeps the rule sensible for large errors."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One measured error.

    Attributes
    ----------
    key : name in results.
    title : for people.
    unit : "" for none.
    summary : makes one number of the values (N,) of all frames, N > 0.
    best : the perfect value: 0 for an error, of which less is better; otherwise more is.
    slack : a stored result may be exceeded by slack + `TOLERANCE_SHARE` * |stored - best| before it counts
        as worse: by what other CPUs change in the last bits of floating-point sums (a marker or a pixel at
        a threshold falls to the other side). For shares of frames, a little more than one frame of the
        quick run's 30.
    """

    key: str
    title: str
    unit: str
    summary: Summary = MEAN
    best: float = 0.0
    slack: float = 0.0

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    def distance(self, value: float) -> float:
        """Distance from the perfect value, >= 0."""
        return abs(value - self.best)

    def allowed(self, stored: float) -> float:
        """The worst value that still counts as no worse than `stored`."""
        margin = self.slack + TOLERANCE_SHARE * self.distance(stored)
        return stored + margin if self.best == 0 else stored - margin

    def is_worse(self, value: float, stored: float) -> bool:
        """Whether `value` is worse than `stored` by more than the tolerance."""
        allowed = self.allowed(stored)
        return value > allowed if self.best == 0 else value < allowed


_ALL = [
    Quantity("displacement_rms", "marker displacement error, RMS", "px", rms, slack=0.004),
    Quantity("displacement_p99", "marker displacement error, 99th percentile", "px", P99, slack=0.02),
    Quantity("wrong_percent", "markers with a wrong identity", "%", slack=0.05),
    Quantity("lost_percent", "visible markers declared lost", "%", slack=0.1),
    Quantity("markers_missed", "markers never found", "", slack=0.5),
    Quantity("markers_false", "false markers", "", slack=0.5),
    Quantity("marker_recall", "markers found (recall)", "", best=1.0, slack=0.005),
    Quantity("marker_precision", "detections that are markers (precision)", "", MEAN, 1.0, slack=0.005),
    Quantity("localisation_rms", "detected centre against true centre, RMS", "px", rms, slack=0.01),
    Quantity("contact_iou", "contact mask, IoU with the truth", "", MEAN, 1.0, slack=0.01),
    Quantity("hull_iou", "contact hull, IoU with the true hull", "", MEAN, 1.0, slack=0.01),
    Quantity("area_error", "hull area error, mean", "%", slack=0.5),
    Quantity("center_error", "contact centre error, mean", "px", slack=0.05),
    Quantity("angle_mean", "direction error, mean", "deg", slack=0.05),
    Quantity("angle_max", "direction error, maximum", "deg", MOST, slack=0.3),
    Quantity("angle_missing", "long contacts without a direction", "%", slack=4.0),
    Quantity("angle_invented", "round contacts with a direction", "%", slack=4.0),
    Quantity("flow_error", "mean flow of the gel in contact, error, mean", "px", slack=0.02),
    Quantity("flow_rms", "mean flow of the gel in contact, error, RMS", "px", rms, slack=0.02),
    Quantity("field_rms", "displacement field in contact, error, RMS", "px", rms, slack=0.02),
    Quantity("depth_rms", "depth in contact, error, RMS", "mm", rms, slack=0.002),
    Quantity("depth_greatest", "greatest depth, error, mean", "%", slack=0.5),
    Quantity("depth_within_one", "greatest depths within one stderr", "%", MEAN, 68.0, slack=15.0),
    Quantity("depth_within_two", "greatest depths within two stderr", "%", MEAN, 95.0, slack=5.0),
    Quantity("flow_within_one", "mean-flow errors within one stderr", "%", MEAN, 68.0, slack=15.0),
    Quantity("flow_within_two", "mean-flow errors within two stderr", "%", MEAN, 95.0, slack=5.0),
    Quantity("false_contacts", "idle frames called contact", "%"),
    Quantity("missed_contacts", "frames with contact missed", "%", slack=4.0),
    Quantity("missed_half_depth", "contact at half depth or more missed", "%"),
    Quantity("inpaint_mae", "marker removal, mean absolute error in the mask", "grey levels", slack=0.1),
]

QUANTITIES: Mapping[str, Quantity] = {quantity.key: quantity for quantity in _ALL}
"""Every quantity by its key."""


class Tally:
    """Values of quantities, frame by frame.

    Attributes
    ----------
    values : key of `QUANTITIES` -> one array (N,) float64 for each frame that has values.
    """

    def __init__(self) -> None:
        self.values: defaultdict[str, list[NDArray[np.float64]]] = defaultdict(list)

    def add(self, **values: ArrayLike) -> None:
        """Add one or several values to each of these quantities."""
        for key, value in values.items():
            self.values[key].append(np.ravel(np.asarray(value, dtype=np.float64)))

    def percent(self, **flags: ArrayLike) -> None:
        """Add truth values, whose mean is a share in percent."""
        self.add(**{key: 100.0 * np.asarray(flag, dtype=np.float64) for key, flag in flags.items()})

    def within(self, key: str, error: ArrayLike, stderr: ArrayLike) -> None:
        """Add errors to the shares KEY_within_one and KEY_within_two of their standard errors."""
        ratio = np.abs(np.asarray(error)) / np.asarray(stderr)
        self.percent(**{f"{key}_within_one": ratio < 1, f"{key}_within_two": ratio < 2})

    def errors(self) -> dict[str, float]:
        """Quantity -> its one number, for those that have values."""
        joined = {key: np.concatenate(arrays) for key, arrays in self.values.items()}
        # Rounding errors of a perfect result count as 0.
        return {
            key: round(float(quantity.summary(joined[key])), 9)
            for key, quantity in QUANTITIES.items()
            if key in joined and joined[key].size
        }
