"""Curves of a run over time: each published quantity that the run has, contacts shaded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from tactflow.drawing.plots import colour, series
from tactflow.vision.arrays import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_POINTS: Final = 2000
"""Points of a curve: more cannot be told apart on a screen, and make a page of an hour too large."""


class Quantity(NamedTuple):
    """A plot: its title, its unit, and its curves as label -> keys and indices of the value in a message.

    Attributes
    ----------
    grows : whether its length says how strong a contact is, so that the largest one is of interest.
    """

    title: str
    unit: str
    curves: Mapping[str, Sequence[str | int]]
    grows: bool = False


def _parts(*path: str | int, names: str = "xyz") -> dict[str, Sequence[str | int]]:
    return {name: (*path, index) for index, name in enumerate(names)}


QUANTITIES: Final = (
    Quantity("Area of the contact", "px²", {"": ("contact", "area")}, grows=True),
    Quantity("Centre of the contact", "px", _parts("contact", "center", names="xy")),
    Quantity("Direction", "degrees", {"": ("contact", "angle")}),
    Quantity("Mean flow in contact", "px", _parts("flow", "mean", names="xy"), grows=True),
    Quantity("Greatest depth", "mm", {"": ("contact", "depth_mm")}, grows=True),
    Quantity("Force", "N", _parts("force", "value"), grows=True),
    Quantity("Probability of slip", "", {"": ("slip", "probability")}),
    Quantity("Object against the gel", "px", _parts("slip", "translation", names="xy"), grows=True),
    Quantity("Probability of contact", "", {"": ("contact", "probability")}),
)
"""What is plotted, in this order."""


class Curves:
    """Collects the quantities of a run, frame by frame: a few numbers of each.

    >>> curves = Curves()
    >>> curves.add({"t": 0.0, "contact": None})
    >>> curves.add({"t": 0.1, "contact": {"area": 40.0}})
    >>> [quantity.title for quantity in curves.present()], curves.contacts()
    (['Area of the contact'], [(0.1, 0.1)])
    """

    def __init__(self) -> None:
        self._paths = {(q.title, label): path for q in QUANTITIES for label, path in q.curves.items()}
        self._values: dict[tuple[str, str], list[float]] = {key: [] for key in self._paths}
        self._t: list[float] = []
        self._touching: list[bool] = []

    def add(self, message: Mapping[str, Any]) -> None:
        """Add one frame, a result message."""
        self._t.append(message["t"])
        self._touching.append(message["contact"] is not None)
        for key, path in self._paths.items():
            value: Any = message
            for step in path:
                if value is not None:
                    value = value.get(step) if isinstance(step, str) else value[step]
            self._values[key].append(np.nan if value is None else float(value))

    @property
    def t(self) -> Floats:
        """(n,) float64, capture time from the first frame, s."""
        return np.asarray(self._t) - (self._t[0] if self._t else 0.0)

    def present(self) -> list[Quantity]:
        """The quantities that at least one frame has."""
        return [q for q in QUANTITIES if any(np.isfinite(self.values(q, label)).any() for label in q.curves)]

    def values(self, quantity: Quantity, label: str) -> Floats:
        """(n,) float64, one curve of a quantity; NaN where a frame lacks it."""
        return np.asarray(self._values[quantity.title, label])

    def contacts(self) -> list[tuple[float, float]]:
        """First and last time of each contact, s from the first frame."""
        touching = np.array([False, *self._touching, False])
        began, ended = np.flatnonzero(np.diff(touching.astype(np.int8))).reshape(-1, 2).T
        return [
            (float(self.t[one]), float(self.t[other - 1])) for one, other in zip(began, ended, strict=True)
        ]

    def draw(self, axes: Axes, quantity: Quantity) -> None:
        """Draw one quantity. A curve has a gap where frames lack it; of long runs, every n-th point."""
        step = -(-len(self._t) // MAX_POINTS) or 1
        for began, ended in self.contacts():
            axes.axvspan(began, ended, color=colour("grid"), linewidth=0)
        for index, label in enumerate(quantity.curves):
            values = self.values(quantity, label)
            axes.plot(self.t[::step], values[::step], color=series(index), label=label or None)
        if len(quantity.curves) > 1:
            axes.legend(loc="upper right", ncols=len(quantity.curves))
        axes.set_title(f"{quantity.title}{quantity.unit and ', ' + quantity.unit}")
        axes.set_xlabel("time, s")
        axes.set_xlim(0, max(float(self.t[-1]), 1e-3))
        if quantity.title.startswith("Probability"):
            axes.set_ylim(-0.05, 1.05)


def collected(messages: Iterable[Mapping[str, Any]]) -> Curves:
    """The curves of a whole run."""
    curves = Curves()
    for message in messages:
        curves.add(message)
    return curves
