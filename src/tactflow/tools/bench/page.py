"""The page of the bench: run time against error, where time goes, how it grows, and what was found."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from itertools import accumulate
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from tactflow.drawing.plots import SERIES
from tactflow.tools.bench.costs import Costs
from tactflow.tools.bench.depth import DEPTH
from tactflow.tools.bench.growth import Growth
from tactflow.tools.bench.latency import percentiles
from tactflow.tools.bench.quantities import QUANTITIES, Quantity
from tactflow.tools.bench.results import CLASSIC, PIPELINE, TRUTH, UNSKIPPED, BenchResult, Measurement
from tactflow.tools.bench.tables import TITLES, number
from tactflow.tools.page import (
    HEIGHT,
    WIDTH,
    Html,
    Section,
    colour,
    details,
    key,
    multiples,
    page,
    plain_numbers,
    plot,
    save_plot,
    series,
    table,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FRONTS: Final = (
    (PIPELINE, "displacement_rms"),
    (PIPELINE, "missed_contacts"),
    (PIPELINE, "hull_iou"),
    (PIPELINE, "center_error"),
    (PIPELINE, "angle_mean"),
    (PIPELINE, "flow_error"),
    (PIPELINE, "field_rms"),
    (DEPTH, "depth_rms"),
    (DEPTH, "depth_greatest"),
    ("tracker", "displacement_rms"),
    ("tracker", "lost_percent"),
    ("marker_mask", "localisation_rms"),
    ("inpaint", "inpaint_mae"),
    ("difference", "missed_contacts"),
    ("difference", "contact_iou"),
    ("difference", "center_error"),
    ("hull", "angle_mean"),
    ("hull", "center_error"),
    ("flow_in_mask", "flow_error"),
)
"""Group and quantity of each plot of time against error."""
PICTURE: Final = (
    ("tracker", "displacement_rms", "Dots: displacement error, RMS, px"),
    ("difference", "contact_iou", "Contact: 1 - overlap with the true one"),
)
"""Group, quantity and title of the panels of `front.png`."""
OURS: Final = "tactflow"
"""Name in `front.png` of what the default pipeline does."""
_NAME_OFFSETS: Final = ((5, 3), (5, -3), (-5, 3), (-5, -3), (0, 14), (0, -14))
"""Where a name may stand beside its point, points to the right and up; the first for want of a free one."""
LINE_CHARACTERS: Final = 44
"""Length of a line that fits above a small plot."""
_MIN_PLOTTED_ERROR: Final = 1e-3
"""Smallest error on a logarithmic axis: an error of 0 is drawn here."""
_LEAD: Final = (
    "Every method and pipeline is a point: CPU time of a frame with contact, in one thread, against its "
    "error, medians over the scenes; lines reach from the lower to the upper quartile. Left and low is "
    "better; the line joins those that nothing beats in both. Errors of 0 lie on the lower edge."
)


class Point(NamedTuple):
    """One method: medians and quartiles over the scenes."""

    name: str
    ms: tuple[float, float, float]
    error: tuple[float, float, float]


def bench_page(result: BenchResult, own: Sequence[str] = ()) -> str:
    """The page, HTML. own : names of the user's pipelines, which are marked like the classic script."""
    machine = ", ".join(f"{name} {value}" for name, value in result.machine.items())
    kind = "quick" if result.quick else "full"
    sections = [
        Section("Time against error", _LEAD, [multiples(_fronts(result, own))]),
        Section("What a frame costs", "Median CPU time of each stage.", _costs(result)),
        *_grasp(result),
        *_growth(result),
        *_latency(result),
        *_pictures(result),
    ]
    return page("tactflow bench", sections, f"A {kind} run of {result.wall_s:.0f} s on {machine}.")


def points(measured: Sequence[Measurement], quantity: Quantity) -> list[Point]:
    """The methods of a group that have both a time and this error."""
    found = []
    for method in dict.fromkeys(m.method for m in measured):
        own = [m for m in measured if m.method == method and m.time_ms and quantity.key in m.values]
        if own:
            times = np.quantile([m.time_ms or 0.0 for m in own], [0.25, 0.5, 0.75])
            errors = np.quantile(
                [quantity.distance(m.values[quantity.key]) for m in own], [0.25, 0.5, 0.75]
            ).round(9)
            found.append(Point(method, tuple(times.tolist()), tuple(errors.tolist())))
    return found


def front(found: Sequence[Point]) -> list[Point]:
    """The points that no other beats in time and error, from the fastest.

    >>> numbers = {"a": (1.0, 5.0), "b": (2.0, 6.0), "c": (3.0, 1.0)}
    >>> found = [Point(name, (ms,) * 3, (error,) * 3) for name, (ms, error) in numbers.items()]
    >>> [point.name for point in front(found)]
    ['a', 'c']
    """
    best: list[Point] = []
    for point in sorted(found, key=lambda point: (point.ms[1], point.error[1])):
        if not best or point.error[1] < best[-1].error[1]:
            best.append(point)
    return best


def _fronts(result: BenchResult, own: Sequence[str]) -> Iterator[Html]:
    for group, name in FRONTS:
        quantity = QUANTITIES[name]
        found = points(result.measurements(group), quantity)
        if len(found) < 2:
            continue

        def draw(figure: Figure, found: Sequence[Point] = found, quantity: Quantity = quantity) -> None:
            draw_front(figure.subplots(), found, quantity, own)

        yield plot(draw, caption=TITLES.get(group, group), height=HEIGHT + 60)


def draw_front(axes: Axes, found: Sequence[Point], quantity: Quantity, own: Sequence[str] = ()) -> None:
    """Draw the methods against one error."""
    draw_points(axes, found, own)
    title = f"1 - {quantity.title}" if quantity.best == 1 else quantity.heading
    axes.set_title(fill(title, LINE_CHARACTERS))


def draw_points(axes: Axes, found: Sequence[Point], own: Sequence[str] = ()) -> None:
    """Draw the methods, their front, and their names; the classic script and `own` ones are marked."""
    times = [ms for point in found for ms in point.ms]
    errors = [max(error, _MIN_PLOTTED_ERROR) for point in found for error in point.error]
    axes.set(xscale="log", yscale="log", xlabel="CPU time of a frame, ms")
    axes.set(xlim=_around(times), ylim=_around(errors))
    for point in found:
        low, middle, high = (max(error, _MIN_PLOTTED_ERROR) for error in point.error)
        across = [[point.ms[1] - point.ms[0]], [point.ms[2] - point.ms[1]]]
        along = [[middle - low], [high - middle]]
        shape, tint = "s" if point.name in (CLASSIC, *own) else "o", _tint(point.name, own)
        place = point.ms[1], middle
        axes.errorbar(*place, yerr=along, xerr=across, fmt=shape, color=tint, elinewidth=0.8, markersize=5)
    best = front(found)
    steps = [max(point.error[1], _MIN_PLOTTED_ERROR) for point in best]
    axes.plot([p.ms[1] for p in best], steps, color=colour("quiet"), linewidth=0.8, zorder=0)
    plain_numbers(axes)
    _write_names(axes, found, own)


def _around(values: Sequence[float]) -> tuple[float, float]:
    """Limits of a logarithmic axis with room for names."""
    low, high = min(values), max(values)
    factor = max(1.5, (high / low) ** 0.2)
    return low / factor, high * factor


def _tint(name: str, own: Sequence[str]) -> str:
    return colour("bad") if name == CLASSIC else colour("good") if name in own else series(0)


def _write_names(axes: Axes, found: Sequence[Point], own: Sequence[str]) -> None:
    """Write the names beside their points, where they cover neither a point nor each other."""
    from matplotlib.transforms import Bbox

    axes.figure.draw_without_rendering()  # type: ignore[union-attr]
    places = [(point.ms[1], max(point.error[1], _MIN_PLOTTED_ERROR)) for point in found]
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in axes.transData.transform(places)]
    for point, place in zip(found, places, strict=True):
        style: dict[str, Any] = {
            "textcoords": "offset points",
            "fontsize": 8,
            "color": _tint(point.name, own),
        }
        for x, y in _NAME_OFFSETS:
            sideways = "left" if x > 0 else "right" if x < 0 else "center"
            upright = "bottom" if y > 0 else "top"
            name = axes.annotate(point.name, place, (x, y), ha=sideways, va=upright, **style)
            name.set_in_layout(False)
            box = name.get_window_extent()
            if axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 and not box.count_overlaps(taken):
                break
            name.remove()
        else:
            axes.annotate(point.name, place, _NAME_OFFSETS[0], **style)
        taken.append(box)


def _costs(result: BenchResult) -> list[Html]:
    stages = list(
        dict.fromkeys(s for kinds in result.costs.values() for spent in kinds.values() for s in spent)
    )

    def draw(figure: Figure, kinds: Mapping[str, Mapping[str, float]]) -> None:
        axes, names = figure.subplots(), list(kinds)[::-1]
        spent = [[kinds[kind].get(stage, 0.0) for stage in stages] for kind in names]
        starts = [[0.0, *accumulate(row)] for row in spent]
        for index in range(len(stages)):
            widths, left = ([row[index] for row in rows] for rows in (spent, starts))
            hatch = "//" if index >= len(SERIES) else ""
            axes.barh(names, widths, left=left, color=series(index), hatch=hatch, edgecolor=colour("panel"))
        axes.set_xlabel("CPU time, ms")

    rows = [
        [f"{name}: {kind}", number(sum(spent.values())), *(number(spent.get(stage, 0.0)) for stage in stages)]
        for name, kinds in result.costs.items()
        for kind, spent in kinds.items()
    ]
    plots = [
        plot(partial(draw, kinds=kinds), caption=name, height=70 + 24 * len(kinds))
        for name, kinds in result.costs.items()
    ]
    return [key(stages), multiples(plots), details("numbers, ms", table(["", "whole", *stages], rows))]


def _grasp(result: BenchResult) -> Iterator[Section]:
    if result.grasp is None:
        return
    name, costs = result.grasp

    def draw(figure: Figure) -> None:
        draw_grasp(figure, costs)

    names = list(costs)
    body = [key(names), plot(draw, width=900, height=360)]
    yield Section(f"Frame by frame: {name}", "What each frame costs, above what happens in it.", body)


def draw_grasp(figure: Figure, costs: dict[str, Costs]) -> None:
    """Draw the cost of each frame of a recording, and the events in it."""
    cost, happens = figure.subplots(2, sharex=True)
    for index, (name, run) in enumerate(costs.items()):
        steps = run.steps
        times = [step.t for step in steps]
        spent = [step.cpu_ms for step in steps]
        cost.step(times, spent, where="mid", color=series(index), linewidth=1, label=name)
    steps = next(iter(costs.values())).steps
    times = [step.t for step in steps]
    happens.plot(times, [step.area / 1000 for step in steps], label="area, 1000 px²", color=series(2))
    happens.plot(times, [step.shift for step in steps], label="largest shift of a dot, px", color=series(3))
    cost.set(ylabel="CPU of a frame, ms", yscale="log")
    plain_numbers(cost)
    happens.set(xlabel="time, s")
    happens.legend(loc="upper right")


def _as_ours(point: Point) -> Point:
    """The way of the default pipeline under the name that readers of the front page know."""
    return point._replace(name=OURS) if point.name == "default" else point


def save_pictures(result: BenchResult, folder: Path) -> list[Path]:
    """Write the pictures of the documentation that a run has the numbers for; returns their paths.

    front.png : time against error of dots and contacts. skipping.png : cost of each frame with and without
    skipping.
    """
    written = []
    stages = [
        (group, [_as_ours(point) for point in points(result.measurements(group), QUANTITIES[name])])
        for group, name, _ in PICTURE
    ]
    if all(len(found) > 1 for _, found in stages):

        def draw(figure: Figure) -> None:
            for axes, (_, found), (_, _, title) in zip(figure.subplots(1, 2), stages, PICTURE, strict=True):
                draw_points(axes, found, [OURS])
                axes.set_title(title)

        written.append(folder / "front.png")
        save_plot(written[-1], draw, width=800, height=320)
    if result.grasp is not None:
        costs = result.grasp[1]
        pair = [name for name in costs if name.endswith(UNSKIPPED)]
        pair += [name.removesuffix(UNSKIPPED) for name in pair]

        def draw_pair(figure: Figure) -> None:
            draw_grasp(figure, {name: costs[name] for name in pair if name in costs})
            figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)

        written.append(folder / "skipping.png")
        save_plot(written[-1], draw_pair, width=800, height=440)
    return written


def _growth(result: BenchResult) -> Iterator[Section]:
    if not result.growth:
        return
    plots = []
    for grown in result.growth:

        def draw(figure: Figure, grown: Growth = grown) -> None:
            axes = figure.subplots()
            axes.fill_between(grown.x, grown.low, grown.high, color=series(0), alpha=0.2, linewidth=0)
            axes.plot(grown.x, grown.ms, "o-", color=series(0))
            linear = 0 in grown.x
            axes.set(xscale="linear" if linear else "log", yscale="linear" if linear else "log")
            axes.set(xlabel=grown.unit or grown.title.lower(), ylabel="CPU of a frame, ms")
            plain_numbers(axes)
            power = grown.exponent
            axes.set_title(grown.title + ("" if power is None else f": grows with the power {power:.2f}"))

        plots.append(plot(draw))
    left_out = [f"{g.title} {size}: {why}" for g in result.growth for size, why in g.left_out.items()]
    text = "Median and quartiles of a frame in contact. The power is that of the larger half of the sizes."
    rows = [[g.title, number(x), number(ms)] for g in result.growth for x, ms in zip(g.x, g.ms, strict=True)]
    body = [multiples(plots), details("numbers", table(["what", "size", "ms"], rows))]
    yield Section("How the cost grows", "\n\n".join([text, *left_out]), body)


def _latency(result: BenchResult) -> Iterator[Section]:
    if not result.latency_ms:
        return

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        ages = np.array(result.latency_ms)
        axes.hist(ages, bins=np.geomspace(ages.min(), ages.max() * 1.001, 60).tolist(), color=series(0))
        for name, value in percentiles(result.latency_ms).items():
            axes.axvline(value, color=colour("quiet"), linewidth=0.8)
            axes.annotate(name, (value, 0.95), xycoords=("data", "axes fraction"), fontsize=8)
        axes.set(xscale="log", xlabel="from capture to message, ms", ylabel="frames")

    shown = ", ".join(f"{name} {value:.2f} ms" for name, value in percentiles(result.latency_ms).items())
    text = f"A live run at 60 Hz with its threads and queues, {len(result.latency_ms)} frames: {shown}."
    yield Section("Latency", text, [plot(draw, width=WIDTH * 2, height=HEIGHT)])


def _pictures(result: BenchResult) -> Iterator[Section]:
    if not result.pictures:
        return
    names = list(dict.fromkeys(name for shown in result.pictures.values() for name in shown))
    names.sort(key=lambda name: name != TRUTH)
    rows = [
        [scene, *(_image(shown[name], f"{scene}, {name}") if name in shown else Html("") for name in names)]
        for scene, shown in result.pictures.items()
    ]
    text = "The deepest frame of each scene: the true outline, and what each pipeline found."
    yield Section("What was found", text, [table(["scene", *names], rows)])


def _image(jpeg: bytes, caption: str) -> Html:
    data = base64.b64encode(jpeg).decode()
    return Html(f'<img loading="lazy" src="data:image/jpeg;base64,{data}" alt="{escape(caption)}">')
