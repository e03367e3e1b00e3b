"""The one style of all plots, by matplotlib (the extra `plot`): colours, sizes, line styles."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from matplotlib.figure import Figure

COLOURS: Final = {
    "ground": ("#f4f6f8", "#0e1216"),
    "panel": ("#fefefe", "#171c22"),
    "line": ("#d9dfe5", "#2a323a"),
    "grid": ("#e6eaee", "#262e36"),
    "text": ("#12181e", "#e9eef2"),
    "quiet": ("#56626e", "#98a5b1"),
    "good": ("#007a57", "#2fc596"),
    "warn": ("#a05a00", "#f0b040"),
    "bad": ("#b84a00", "#ff8a4c"),
    "series-1": ("#0072b2", "#56b4e9"),
    "series-2": ("#d55e00", "#ee9b4b"),
    "series-3": ("#00805c", "#30c598"),
    "series-4": ("#b0558f", "#e08fc0"),
    "series-5": ("#8f7400", "#e6d84a"),
    "series-6": ("#5a6672", "#b8bcc0"),
    "series-7": ("#3d4db7", "#a3b0ff"),
    "series-8": ("#9b2d30", "#ff9c9f"),
}
"""Name -> (light, dark). The series are Okabe and Ito's colours, distinct for all types of colour vision."""
SERIES: Final = tuple(name for name in COLOURS if name.startswith("series"))
DASHES: Final = ("-", "--", "-.", ":")
"""Line styles once the colours are used up."""
DPI: Final = 72
"""One point of matplotlib is one CSS pixel."""
PICTURE_DPI: Final = 144
"""Of pictures of the docs: two pixels for a CSS pixel, for sharp screens."""


def colour(name: str) -> str:
    """A colour of `COLOURS` in plots; in the page it follows the reader's light or dark scheme."""
    return COLOURS[name][0]


def series(index: int) -> str:
    """Colour of a series in plots, as in `key`."""
    return colour(SERIES[index % len(SERIES)])


def dashes(index: int) -> str:
    """Line style of a series in plots: solid until the colours repeat."""
    return DASHES[index // len(SERIES) % len(DASHES)]


@contextmanager
def styled_figure(width: int, height: int) -> Iterator[Figure]:
    """A figure with the style of all plots, without the global state of pyplot."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_style()):
        yield Figure(figsize=(width / DPI, height / DPI), dpi=DPI, layout="constrained")


def _style() -> Any:
    from cycler import cycler

    cycle = cycler(color=[colour(name) for name in SERIES])
    names = ("xtick.color", "ytick.color", "axes.labelcolor")
    return {
        **dict.fromkeys(names, colour("quiet")),
        **dict.fromkeys(("text.color", "axes.titlecolor"), colour("text")),
        **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), colour("panel")),
        **dict.fromkeys(("axes.spines.top", "axes.spines.right"), False),
        **{"axes.edgecolor": colour("line"), "axes.grid": True, "grid.color": colour("grid")},
        **{"axes.prop_cycle": cycle, "axes.axisbelow": True, "axes.titlelocation": "left"},
        **{"font.size": 10, "axes.titlesize": 11, "axes.labelsize": 10, "legend.fontsize": 9},
        **{"font.family": "sans-serif", "lines.linewidth": 1.6, "lines.markersize": 4},
        **{"legend.frameon": False, "svg.fonttype": "none", "svg.hashsalt": "tactflow"},
    }
