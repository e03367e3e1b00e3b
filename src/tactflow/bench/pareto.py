"""Methods as points of run time and error, and those that no other beats in both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median

from tactflow.bench.quantities import Quantity
from tactflow.bench.results import Measurement, Result


@dataclass(frozen=True, slots=True)
class Point:
    """One method in a plot.

    cost : copies of a raw frame. error : median over scenes, as distance from the perfect value.
    low, high : the best and the worst scene. scenes : how many, worst : the name of the worst one.
    missing : scenes in which others have this quantity and this method has nothing to show.
    """

    method: str
    cost: float
    error: float
    low: float
    high: float
    scenes: int
    worst: str
    missing: int = 0


def cost_of(measurements: Iterable[Measurement]) -> float | None:
    """Median over scenes of the time of a frame with contact, copies; of any frame where none had contact."""
    costs = [m.copies.get("contact", m.copies.get("all", m.copies.get("idle"))) for m in measurements]
    known = [cost for cost in costs if cost]
    return median(known) if known else None


def points(result: Result, group: str, quantity: Quantity) -> list[Point]:
    """One point per method of a group that has both a time and this error."""
    known = {
        method: [m for m in result.of(group, method) if quantity.key in m.errors]
        for method in result.methods(group)
    }
    everywhere = {m.scene for rows in known.values() for m in rows}
    found = []
    for method, rows in known.items():
        cost = cost_of(rows)
        if not rows or cost is None:
            continue
        errors = [quantity.distance(m.errors[quantity.key]) for m in rows]
        worst = max(zip(errors, (m.scene for m in rows), strict=True))
        missing = len(everywhere) - len(rows)
        found.append(
            Point(method, cost, median(errors), min(errors), max(errors), len(rows), worst[1], missing)
        )
    return found


def pareto(candidates: Sequence[Point]) -> list[Point]:
    """The points that no other beats in both time and error, by rising cost.

    A method that has nothing to show in some scenes is left out: its median is that of the easy ones.
    """
    front: list[Point] = []
    whole = [p for p in candidates if not p.missing]
    for point in sorted(whole, key=lambda p: (p.cost, p.error)):
        if not front or point.error < front[-1].error:
            front.append(point)
    return front


def limit_of(result: Result, group: str, quantity: Quantity) -> float | None:
    """Median over the scenes of the smallest error that physics allows, or None where it is not known."""
    limits = [m.limits[quantity.key] for m in result.of(group) if quantity.key in m.limits]
    return median(limits) if limits else None
