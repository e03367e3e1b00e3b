"""Run time against error as an SVG plot, both axes logarithmic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import Final

from tactflow.bench.log_axis import LogAxis
from tactflow.bench.pareto import Point, pareto
from tactflow.bench.quantities import Quantity, format_number

WIDTH: Final = 620
HEIGHT: Final = 400
"""Size of the plot, px. This and all lengths below were chosen by hand, for text of 12 px."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 78, 16, 14, 52
"""Margins around the area of the points, px."""

_ZERO_BAND: Final = 26
"""Height of the band for errors of 0, which a logarithmic axis does not have, px."""

_SHORTEST_AXIS: Final = 1.2
"""Decades that an axis spans at least."""

_ROOM_FOR_NAME: Final = 0.28
"""Part of the x axis that is added on the right, for the name of the slowest method."""

_LABEL_DISTANCES: Final = (9.0, 20.0, 34.0, 50.0, 68.0)
"""Distances from a point at which its name may stand, px; from the third on a line leads to it."""

_LABEL_PLACES: Final = (
    (1, 0, "start"),
    (-1, 0, "end"),
    (0, -1, "middle"),
    (0, 1, "middle"),
    (1, -1, "start"),
    (1, 1, "start"),
    (-1, -1, "end"),
    (-1, 1, "end"),
)
"""Directions (x, y down) in which a name may stand, the best first, and its anchor there."""


@dataclass(frozen=True, slots=True)
class _Box:
    x0: float
    y0: float
    x1: float
    y1: float

    def overlap(self, other: _Box) -> float:
        width = min(self.x1, other.x1) - max(self.x0, other.x0)
        height = min(self.y1, other.y1) - max(self.y0, other.y0)
        return width * height if width > 0 and height > 0 else 0.0


class _Plot:
    """The plot while it is drawn, from back to front.

    svg : its elements so far. taken : places that a name must not cover.
    """

    def __init__(
        self, candidates: Sequence[Point], quantity: Quantity, limit: float | None, floor: float | None
    ) -> None:
        self.candidates, self.quantity = candidates, quantity
        self.front = pareto(candidates)
        self.has_zero = any(p.low == 0 for p in candidates)
        self.positive = [v for p in candidates for v in (p.low, p.error, p.high) if v > 0]
        if limit:
            self.positive.append(limit)
        self.bottom = HEIGHT - _BOTTOM - (_ZERO_BAND if self.has_zero else 0)
        self.zero_y = HEIGHT - _BOTTOM - _ZERO_BAND / 2
        costs = [p.cost for p in candidates] + ([floor] if floor else [])
        across = LogAxis.around(costs, _LEFT, WIDTH - _RIGHT, _SHORTEST_AXIS)
        self.x_axis = replace(across, high=across.high + _ROOM_FOR_NAME * (across.high - across.low))
        self.y_axis = LogAxis.around(self.positive or [1.0], self.bottom, _TOP, _SHORTEST_AXIS)
        self.places = {p.method: (self.x_axis.at(p.cost), self.y_of(p.error)) for p in candidates}
        self.on_front = {p.method for p in self.front}
        self.svg: list[str] = []
        self.taken: list[_Box] = []

    def y_of(self, value: float) -> float:
        return self.y_axis.at(value) if value > 0 else self.zero_y

    def kind(self, point: Point) -> str:
        """The CSS class of a point on the Pareto front, or off it."""
        return "on" if point.method in self.on_front else "off"

    def draw_axes(self) -> None:
        """Title, grid, ticks, the band of zeros and the names of both axes."""
        quantity = self.quantity
        unit = f", {quantity.unit}" if quantity.unit else ""
        best = format_number(quantity.best)
        measured = f"error{unit}" if quantity.best == 0 else f"distance from {best}{unit}"
        shown = quantity.title if quantity.best == 0 else f"{best} - {quantity.title}"
        self.svg.append(
            f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
            f'aria-label="{escape(shown)} against run time"><title>{escape(shown)} against run time</title>'
        )
        for value in self.x_axis.ticks():
            x = self.x_axis.at(value)
            self._line("grid", x, _TOP, x, HEIGHT - _BOTTOM)
            self._text("tick", f"{x:.1f}", f"{HEIGHT - _BOTTOM + 16}", "middle", format_number(value))
        for value in self.y_axis.ticks() if self.positive else ():
            y = self.y_axis.at(value)
            self._line("grid", _LEFT, y, WIDTH - _RIGHT, y)
            self._text("tick", f"{_LEFT - 7}", f"{y + 4:.1f}", "end", format_number(value))
        if self.has_zero:
            self.svg.append(
                f'<rect class="zero" x="{_LEFT}" y="{self.bottom}" width="{WIDTH - _LEFT - _RIGHT}" '
                f'height="{_ZERO_BAND}"/>'
            )
            self._text("tick", f"{_LEFT - 7}", f"{self.zero_y + 4}", "end", "none")
        self.svg.append(
            f'<text class="axis" x="{(_LEFT + WIDTH - _RIGHT) / 2}" y="{HEIGHT - 12}" text-anchor="middle">'
            "CPU time of a frame, copies of a raw frame (log)</text>"
            f'<text class="axis" transform="translate(16 {(HEIGHT - _BOTTOM + _TOP) / 2}) rotate(-90)" '
            f'text-anchor="middle">{escape(measured)} (log)</text>'
        )

    def draw_limits(self, limit: float | None, floor: float | None) -> None:
        """The smallest error that physics allows, and the time to touch every byte once."""
        if limit:
            y = self.y_axis.at(limit)
            self._line("limit", _LEFT, y, WIDTH - _RIGHT, y)
            words = f"Cramér-Rao limit {format_number(limit)}"
            self._text("limit-label", f"{WIDTH - _RIGHT - 4}", f"{y - 5:.1f}", "end", words)
            self.taken.append(_Box(WIDTH - _RIGHT - 160, y - 18, WIDTH - _RIGHT, y + 2))
        if floor:
            x = self.x_axis.at(floor)
            self._line("limit", x, _TOP, x, HEIGHT - _BOTTOM)
            self.svg.append(
                f'<text class="limit-label" transform="translate({x - 5:.1f} {_TOP + 6}) rotate(-90)" '
                'text-anchor="end">every byte touched once</text>'
            )
            self.taken.append(_Box(x - 17, _TOP, x + 2, _TOP + 150))

    def draw_points(self) -> None:
        """The Pareto front and every method's point, those on the front above the others."""
        if self.front:
            steps = [f"M {self.x_axis.at(self.front[0].cost):.1f} {_TOP}"]
            steps += [f"H {self.x_axis.at(p.cost):.1f} V {self.y_of(p.error):.1f}" for p in self.front]
            self.svg.append(f'<path class="front" d="{" ".join(steps)} H {WIDTH - _RIGHT}"/>')
        self.taken += [_Box(x - 6, y - 6, x + 6, y + 6) for x, y in self.places.values()]
        for point in sorted(self.candidates, key=lambda p: p.method in self.on_front):
            self._draw_point(point)

    def _draw_point(self, point: Point) -> None:
        """One method, with the span of its scenes and a tip for the mouse."""
        x, y = self.places[point.method]
        kind = self.kind(point)
        tip = (
            f"{point.method}: {format_number(point.cost)} copies, error {format_number(point.error)} "
            f"{self.quantity.unit} (median of {point.scenes} scenes; best {format_number(point.low)}, "
            f"worst {format_number(point.high)} on {point.worst})"
            + (f"; nothing to show in {point.missing} scenes" if point.missing else "")
        )
        self.svg.append(f"<g><title>{escape(tip)}</title>")
        if point.scenes > 1:
            self._line(f"whisker {kind}", x, self.y_of(point.high), x, self.y_of(point.low))
        kind += " partial" if point.missing else ""
        self.svg.append(f'<circle class="dot {kind}" cx="{x:.1f}" cy="{y:.1f}" r="5"/></g>')

    def draw_names(self) -> None:
        """Every method's name near its point, those on the front first, since they choose their places."""
        for point in sorted(self.candidates, key=lambda p: p.method not in self.on_front):
            x, y = self.places[point.method]
            box, anchor, leader = _place_label(point.method, x, y, self.taken)
            self.taken.append(box)
            if leader:
                end = box.x0 if box.x0 > x else box.x1 if box.x1 < x else (box.x0 + box.x1) / 2
                self._line("leader", x, y, end, (box.y0 + box.y1) / 2)
            text_x = {"start": box.x0, "end": box.x1, "middle": (box.x0 + box.x1) / 2}[anchor]
            place = f"{text_x:.1f}", f"{box.y1 - 4:.1f}"
            self._text(f"name {self.kind(point)}", *place, anchor, escape(point.method))

    def _line(self, kind: str, x1: float, y1: float, x2: float, y2: float) -> None:
        self.svg.append(f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>')

    def _text(self, kind: str, x: str, y: str, anchor: str, words: str) -> None:
        self.svg.append(f'<text class="{kind}" x="{x}" y="{y}" text-anchor="{anchor}">{words}</text>')


def scatter(candidates: Sequence[Point], quantity: Quantity, limit: float | None, floor: float | None) -> str:
    """Draw methods by run time and error.

    Parameters
    ----------
    candidates : at least one point.
    quantity : what the y axis shows.
    limit : smallest error that physics allows, or None.
    floor : cost of touching every byte of a raw frame once, copies, or None.
    """
    plot = _Plot(candidates, quantity, limit, floor)
    plot.draw_axes()
    plot.draw_limits(limit, floor)
    plot.draw_points()
    plot.draw_names()
    return "".join([*plot.svg, "</svg>"])


def _place_label(text: str, x: float, y: float, taken: Sequence[_Box]) -> tuple[_Box, str, bool]:
    """The free place for a label that is nearest to its point, or the least crowded one."""
    width, height = 7.0 * len(text) + 4, 16.0
    best: tuple[float, _Box, str, bool] | None = None
    for distance in _LABEL_DISTANCES:
        for dx, dy, anchor in _LABEL_PLACES:
            cx, cy = x + dx * distance, y + dy * (distance + 2)
            left = {"start": cx, "end": cx - width, "middle": cx - width / 2}[anchor]
            box = _Box(left, cy - height / 2, left + width, cy + height / 2)
            outside = (
                max(0.0, _LEFT - box.x0)
                + max(0.0, box.x1 - (WIDTH - 2))
                + max(0.0, 2 - box.y0)
                + max(0.0, box.y1 - (HEIGHT - _BOTTOM))
            )
            crowd = sum(box.overlap(other) for other in taken) + 100 * outside
            score = crowd + 0.3 * distance
            if best is None or score < best[0]:
                best = (score, box, anchor, distance > 20)
        if best is not None and best[0] < 0.3 * distance + 1:
            break
    assert best is not None
    return best[1], best[2], best[3]
