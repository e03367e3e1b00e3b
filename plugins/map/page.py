"""The page about a map: views of the surface, of its errors, and of the way of the contact over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from tactflow.tools.page import Html, Section, colour, multiples, page, plot, table
from tactflow.vision.arrays import Floats
from tactflow.vision.pose.rigid import inverse, skew

from .graph import Graph
from .keyframes import Contact
from .surface import Points
from .viewer import viewer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

VIEWS: Final = {
    "as the gel touches it": ((1, 0, 0), (0, 1, 0)),
    "from the left": ((0, 0, 1), (0, 1, 0)),
    "from the right": ((0, 0, -1), (0, 1, 0)),
    "from above": ((1, 0, 0), (0, 0, 1)),
    "from below": ((1, 0, 0), (0, 0, -1)),
    "from behind": ((-1, 0, 0), (0, 1, 0)),
}
"""Name of a view -> directions to the right and downwards in it, in the axes of the object."""
MIN_VIEW_SHARE: Final = 0.15
"""Share of the points that one of several views shows at least."""
ONE_SIDED: Final = 0.7
"""Length of the mean normal from which one view shows the surface: that of a cap of 66 degrees."""
SMOOTH_DEGREE: Final = 4
"""Degree of the polynomial that is the smooth shape: a third of a ball is one within 1 % of its radius."""
NEAREST: Final = 8
"""Points that a pixel is the mean of, at most."""
MIN_FACING: Final = 0.5
"""Cosine of the steepest surface that counts as shown by a view: 60 degrees."""
LIGHT: Final = np.array([-0.45, -0.6, -0.66])
"""Direction to the light of shaded views, to the right, downwards and away from the viewer."""
STEP_CELLS: Final = 0.5
"""Pixel of a view, cells."""
FILLED_CELLS: Final = 1.2
"""Largest distance of a pixel from the points that it shows, cells."""
LAYER_MM: Final = 1.0
"""Points farther than this behind the foremost one are hidden by it, mm."""
UNKNOWN_STDERRS: Final = (0.3, 5.0)
"""Standard errors, mm and degrees, above which a place or a turn counts as not seen."""
SMALL_VIEW = 360, 300
"""Size of a plot of one of several views, CSS pixels."""
LARGE_VIEW = 540, 510
"""Largest size of the picture of a single view, CSS pixels."""
AROUND_VIEW = 190, 50
"""What the plot of a single view has beside its picture, for labels and colours, and below it, CSS pixels."""


class View(NamedTuple):
    """A picture of the points.

    Attributes
    ----------
    extent : left, right, bottom, top, mm.
    relief : (h, w), mm towards the viewer from the smooth shape of the surface, NaN where nothing is shown.
    shade : (h, w), 0 to 1, light that the surface reflects.
    error : (h, w), standard error, mm.
    path : (N, 2), way of the middle of the contact where it is on this side, NaN between, mm.
    """

    extent: tuple[float, float, float, float]
    relief: Floats
    shade: Floats
    error: Floats
    path: Floats


Draw: TypeAlias = "Callable[[Figure, View], None]"


def views(points: Points, contact: Contact, graph: Graph, cell: float) -> dict[str, View]:
    """The views of a surface: one from its mean normal, or several where it goes around an object.

    cell : distance of points, mm.
    """
    axes = facing(points)
    if axes is not None:
        return {"": _view(points, contact, graph, cell, axes)}
    found = {}
    for name, (right, down) in VIEWS.items():
        axes = np.array([right, down, np.cross(right, down)], np.float64)
        if np.mean(points.normal @ axes[2] < -MIN_FACING) >= MIN_VIEW_SHARE:
            found[name] = _view(points, contact, graph, cell, axes)
    return found


def facing(points: Points) -> Floats | None:
    """(3, 3): axes of a view, see `_view`, that shows the whole surface; None where it goes around an
    object."""
    mean = points.normal.mean(axis=0)
    if np.linalg.norm(mean) < ONE_SIDED:
        return None
    away = -mean / np.linalg.norm(mean)
    down = np.cross(away, (1.0, 0.0, 0.0))
    down /= np.linalg.norm(down)
    return np.array([np.cross(down, away), down, away])


def _view(points: Points, contact: Contact, graph: Graph, cell: float, axes: Floats) -> View:
    """axes : (3, 3), directions to the right, downwards and away from the viewer."""
    shown = points.at(points.normal @ axes[2] < -MIN_FACING)
    place, normal = shown.place @ axes.T, shown.normal @ axes.T
    low, high = place[:, :2].min(axis=0) - cell, place[:, :2].max(axis=0) + cell
    step = STEP_CELLS * cell
    across, down = (np.arange(low[k], high[k], step) for k in (0, 1))
    pixels = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    near = min(NEAREST, len(shown))
    away, index = cKDTree(place[:, :2]).query(pixels, k=near, distance_upper_bound=FILLED_CELLS * cell)
    away = np.asarray(away).reshape(-1, near)
    index = np.minimum(np.asarray(index).reshape(-1, near), len(shown) - 1)
    behind = np.where(np.isfinite(away), place[index, 2], np.inf)
    front = behind < behind.min(axis=1, keepdims=True) + LAYER_MM
    weight = np.where(front, np.exp(-((np.where(front, away, 0) / (0.5 * cell)) ** 2)), 0)
    total = weight.sum(axis=1)
    weight /= np.where(total > 0, total, np.nan)[:, None]
    mean = np.einsum("pk,pki->pi", weight, normal[index])
    light = mean @ LIGHT / (np.linalg.norm(mean, axis=1) * np.linalg.norm(LIGHT))
    values = _relief(place), shown.error
    relief, error = (np.asarray(np.sum(weight * part[index], axis=1)) for part in values)
    right, bottom = low + step * np.array([len(across), len(down)])
    extent = float(low[0]), float(right), float(bottom), float(low[1])
    path = _path(contact, graph, axes)
    shape = len(down), len(across)
    shade = np.asarray(np.maximum(light, 0))
    return View(extent, relief.reshape(shape), shade.reshape(shape), error.reshape(shape), path)


def _relief(place: Floats) -> Floats:
    """(N,): how far points (N, 3) are nearer to the viewer than a polynomial through all of them."""
    spread = np.ptp(place[:, :2], axis=0)
    across, down = ((place[:, :2] - place[:, :2].mean(axis=0)) / np.maximum(spread, 1e-9)).T
    powers = [(i, k) for i in range(SMOOTH_DEGREE + 1) for k in range(SMOOTH_DEGREE + 1 - i)]
    terms = np.column_stack([across**i * down**k for i, k in powers])
    smooth = terms @ np.linalg.lstsq(terms, place[:, 2], rcond=None)[0]
    return np.asarray(smooth - place[:, 2])


def _path(contact: Contact, graph: Graph, axes: Floats) -> Floats:
    """The middle of each keyframe's patch; NaN where the object's other side is touched."""
    places = []
    for keyframe, pose in zip(contact.keyframes, graph.poses, strict=True):
        back = inverse(pose)
        place = axes @ (back[:3, :3] @ keyframe.template.center + back[:3, 3])
        places.append(place[:2] if axes[2] @ back[:3, 2] > 0 else np.full(2, np.nan))
    return np.array(places)


def draw_relief(figure: Figure, view: View) -> None:
    """The shaded surface, coloured by its relief, with the way of the contact."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    axes = figure.subplots()
    bounds = Normalize(*np.nanquantile(view.relief, (0.01, 0.99)).tolist())
    picture = colormaps["viridis"](np.nan_to_num(np.asarray(bounds(view.relief))))
    picture[..., :3] *= (0.3 + 0.9 * np.nan_to_num(view.shade))[..., None]
    picture[..., 3] = np.isfinite(view.relief)
    axes.imshow(np.clip(picture, 0, 1), extent=view.extent, interpolation="bilinear")
    axes.plot(*view.path.T, "-", color=colour("series-2"), linewidth=1, marker=".", markersize=3)
    figure.colorbar(ScalarMappable(bounds, "viridis"), ax=axes, label="relief, mm", shrink=0.8)
    _labelled(axes)


def draw_error(figure: Figure, view: View) -> None:
    """Standard errors along the normal."""
    axes = figure.subplots()
    most = float(np.nanquantile(view.error, 0.98))
    shown = axes.imshow(view.error, extent=view.extent, cmap="magma", vmin=0, vmax=most)
    figure.colorbar(shown, ax=axes, label="standard error, mm", shrink=0.8)
    _labelled(axes)


def _plot(draw: Draw, view: View, what: str, seen: str, *, alone: bool) -> Html:
    """A plot. what : it shows. seen : name of the view. alone : the only one."""
    left, right, bottom, top = view.extent
    size = np.array([right - left, bottom - top])
    picture = size * np.min(np.array(LARGE_VIEW) / size)
    width, height = np.rint(picture + AROUND_VIEW).astype(int).tolist() if alone else SMALL_VIEW
    label = f"{what} {seen}".strip()
    return plot(
        lambda figure: draw(figure, view),
        caption=seen,
        label=label,
        width=width,
        height=height,
        shrinks=alone,
    )


def _labelled(axes: Axes) -> None:
    axes.grid(visible=False)
    axes.set(xlabel="mm", ylabel="mm", aspect="equal")


def map_page(name: str, points: Points, contact: Contact, graph: Graph, cell: float) -> str:
    """The page, HTML. name : of the recording. cell : distance of points, mm."""
    shown, axes = views(points, contact, graph, cell), facing(points)

    alone = len(shown) == 1

    def plots(draw: Draw, what: str) -> list[Html]:
        drawn = [_plot(draw, view, what, seen, alone=alone) for seen, view in shown.items()]
        return drawn if alone else [multiples(drawn)]

    sections = [
        Section(
            "Surface",
            "Colour is the relief: the height towards the gel, less the smooth shape. Light comes from the "
            "upper left. The line is the way of the middle of the contact, with a dot for each keyframe.",
            plots(draw_relief, "relief"),
        ),
        Section(
            "Errors",
            "Standard error of the surface along its normal, from heights, calibration and poses.",
            plots(draw_error, "standard errors"),
        ),
        Section("Turn it", body=[viewer(points, cell, np.eye(3) if axes is None else axes)]),
        Section("What was measured", body=[_facts(points, contact, graph)]),
    ]
    lead = "\n\n".join([summary(points, contact), *unseen(contact, graph)])
    return page(f"Map of {name}", sections, lead)


def summary(points: Points, contact: Contact) -> str:
    """A sentence about the surface."""
    size = " x ".join(f"{side:.1f}" for side in np.ptp(points.place, axis=0))
    median, most = np.quantile(points.error, (0.5, 0.9))
    return (
        f"A surface of {size} mm, {len(points)} points, from {contact.frames} frames: "
        f"standard error {median:.3f} mm (median), {most:.3f} mm (90 %)."
    )


def unseen(contact: Contact, graph: Graph) -> Iterator[str]:
    """What patches of half the largest size and more do not show about the motion of the object, a sentence
    each."""
    worst = [(0.0, 0, np.zeros(3))] * 2
    largest = contact.keyframes[graph.anchor].imprint.area
    for index, keyframe in enumerate(contact.keyframes):
        if keyframe.imprint.area < largest / 2:
            continue
        covariance = graph.covariance(index)[:6, :6]
        place = keyframe.template.center
        moves = np.concatenate([np.eye(3), skew(place)], axis=1)
        for kind, matrix in enumerate((moves @ covariance @ moves.T, covariance[3:, 3:])):
            values, axes = np.linalg.eigh(matrix)
            error = float(np.sqrt(max(values[-1], 0)))
            if error > worst[kind][0]:
                worst[kind] = error, index, axes[:, -1]
    (shift, at, way), (turn, turned_at, axis) = worst
    if np.degrees(turn) > UNKNOWN_STDERRS[1]:
        yield (
            f"Turns are not well seen: in frame {contact.keyframes[turned_at].seq} that about "
            f"({_vector(axis)}) has a standard error of {np.degrees(turn):.0f} degrees. Smooth balls, "
            "flats and regular threads do not show it; dots on the gel do."
        )
    if shift > UNKNOWN_STDERRS[0]:
        yield (
            f"Places are not well seen: in frame {contact.keyframes[at].seq} the object's place along "
            f"({_vector(way)}) has a standard error of {shift:.2f} mm."
        )


def _vector(axis: Floats) -> str:
    return ", ".join(f"{part:.1f}" for part in axis)


def _facts(points: Points, contact: Contact, graph: Graph) -> Html:
    loops = len(graph.edges) - len(contact.edges)
    too_small, stderr = 100 * graph.slope_error, 100 * float(np.sqrt(graph.covariance()[0, 0]))
    rows: Sequence[Sequence[object]] = [
        ["frames in contact", contact.frames],
        ["keyframes", len(contact.keyframes)],
        ["loops closed", loops],
        ["all slopes are too small by", f"{too_small:z.1f} ± {stderr:.1f} %"],
        ["standard error along the surface, median, mm", f"{np.median(points.shift):.3f}"],
    ]
    return table(["", ""], rows)
