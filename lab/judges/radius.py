"""Compare the radius of contacts with balls of known size and with labelled circles, set by set.

    python -m lab.judges.radius --data RECORDINGS [--picture profile.png] [SET ...]

Columns: presses; the median radius over that of a labelled circle, of the whole imprint (`area`) and of its
core (`core_area`); and the same over the radius at which the gel leaves the ball. The latter is where the
slope, learned from the presses themselves, has fallen to 0.7 of that of a ball of this size, so that it does
not depend on the eye of a person. Then the labelled circle over it; and the setting `core` that `tactflow
calibrate` proposes for every second press, and what it gives on the others. In brackets: 10 and 90 %
quantiles.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.depth import SETS, Balls, radii_of, read, scale_of
from lab.judges.judge import OUTLINES
from lab.judges.label_file import load_labels
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Session
from tactflow.calibration.samples import fitting_core, flat, prepared
from tactflow.engine.errors import TactflowError
from tactflow.system.terminal import say, table
from tactflow.tools.page import save_plot, series
from tactflow.vision.contact.contact_outline import CORE_SLOPE_FRACTION

if TYPE_CHECKING:
    from matplotlib.figure import Figure

JUDGED: Final[Mapping[str, Balls]] = {
    "gelslim_ball": Balls("gels/gelslim_ball", "000.jpg", "gelslim", 1.0, {}),
    **SETS,
}
"""Sets of presses of balls; those without a known ball are compared with labels only."""
PROFILE_SETS: Final = {"mini_ball_9mm": "thin gel (Mini)", "wedge_ball": "thick gel (Wedge with dots)"}
"""Sets whose profiles `--picture` draws, and their titles."""
PROFILE_RADII: Final = np.arange(0.05, 2.0, 0.05)
"""Distances from the middle of a ball in the picture, in radii at which the gel leaves the ball."""
Numbers = NDArray[np.float64]
HEADING: Final = (
    *("set", "presses", "area/label", "core/label", "area/ball", "core/ball", "label/ball"),
    *("core fitted", "core/ball with it"),
)
"""Columns of the table."""


class Profile(NamedTuple):
    """Slope across the border of a ball, median of the presses of a set.

    slope, ball : (k,), fitted slope and that of the ball, over the largest fitted one, at `PROFILE_RADII`.
    outline, core : their radii over that at which the gel leaves the ball.
    """

    slope: Numbers
    ball: Numbers
    outline: float
    core: float


class Radii(NamedTuple):
    """Radii of the presses of a set, (n,) each, processed px; NaN where unknown."""

    outline: Numbers
    core: Numbers
    label: Numbers
    ball: Numbers


class Fitted(NamedTuple):
    """The setting `core` that fits every second press, and what it gives on the others.

    ratio : (n,), radius of the core over that at which the gel leaves the ball.
    """

    core: float
    ratio: Numbers


def labelled_radii(folder: Path, recording: str) -> dict[str, float]:
    """Name of a picture without suffix -> radius of its labelled circle, px: of `labels.csv` or `labels.json`
    in the folder, or of the package's outlines of this recording."""
    if (path := folder / "labels.csv").exists():
        with path.open(newline="") as file:
            picture, *columns = csv.DictReader(file).fieldnames or [""]
            file.seek(0)
            radius = next((name for name in columns if name.startswith("radius")), None)
            if radius is not None:
                return {Path(row[picture]).stem: float(row[radius]) for row in csv.DictReader(file)}
    if (path := folder / "labels.json").exists():
        entries = json.loads(path.read_text()).items()
        return {name: float(entry["radius"]) for name, entry in entries if "radius" in entry}
    return {
        str(label.frame): float(np.sqrt(cv2.contourArea(np.float32(label.outlines[0])) / np.pi))
        for label in load_labels(OUTLINES)
        if label.recording == recording and label.round == 1 and len(label.outlines) == 1
    }


def judge(balls: Balls, data: Path) -> tuple[Radii, Profile | None, Fitted | None]:
    """Radii of a set, and if its balls are known its profile and the setting that fits.

    Errors are those of `fit_photometry`.
    """
    session, names = read(balls, data)
    labels = labelled_radii(data / balls.folder, balls.folder)
    label = np.array([labels.get(Path(name).stem, np.nan) for name in names])
    outline, core = (
        np.array([getattr(press, key) for press in session.presses]) for key in ("radius", "core_radius")
    )
    if not balls.radii:
        return Radii(outline, core, label, np.full(len(names), np.nan)), None, None
    edges, profile = _leaving(balls, session, names)
    medians = (float(np.nanmedian(part / edges)) for part in (outline, core))
    setting = fitting_core(float(np.nanmedian((core / edges)[::2])), CORE_SLOPE_FRACTION)
    again, _ = read(balls, data, {"stages.difference.core": setting})
    fitted = np.array([press.core_radius for press in again.presses]) / edges
    return Radii(outline, core, label, edges), Profile(*profile, *medians), Fitted(setting, fitted[1::2])


def _leaving(balls: Balls, session: Session, names: list[str]) -> tuple[Numbers, tuple[Numbers, Numbers]]:
    """Where the gel leaves the ball in each press, px, NaN in those that the fit rejects; and the slopes of
    `Profile`."""
    scale, sizes = scale_of(balls, session), np.array(radii_of(balls, names))
    fit = fit_photometry(session, scale, sizes.tolist())
    weights = flat(fit.model)
    edges, slopes, true = np.full(len(names), np.nan), [], []
    for number, sample in enumerate(prepared(session, scale, sizes)):
        center = sample.center(sample.start, weights)
        edge = sample.edge(center, weights) if fit.kept[number] else np.nan
        if np.isnan(edge):
            continue
        edges[number] = edge / balls.mm
        places, slope = sample.profile(center, weights)
        largest = slope.max()
        slopes.append(np.interp(PROFILE_RADII, places / edge, slope / largest, left=np.nan, right=np.nan))
        true.append(np.minimum(PROFILE_RADII * edge / sample.ball_radius, 1) / largest)
    seen = [[slope for slope in ring if np.isfinite(slope)] for ring in np.transpose(slopes)]
    medians = np.array([np.median(ring) if ring else np.nan for ring in seen])
    return edges, (medians, np.median(true, axis=0))


def row(name: str, radii: Radii, fitted: Fitted | None) -> tuple[str, ...]:
    """A row of the table."""
    ratios = (
        radii.outline / radii.label,
        radii.core / radii.label,
        radii.outline / radii.ball,
        radii.core / radii.ball,
        radii.label / radii.ball,
    )
    by_core = ("-", "-") if fitted is None else (f"{fitted.core:.2f}", _spread(fitted.ratio))
    return name, str(len(radii.outline)), *(_spread(ratio) for ratio in ratios), *by_core


def _spread(ratios: Numbers) -> str:
    known = ratios[np.isfinite(ratios)]
    if not known.size:
        return "-"
    low, middle, high = np.quantile(known, [0.1, 0.5, 0.9])
    return f"{middle:.2f} ({low:.2f}-{high:.2f})"


def draw(profiles: Mapping[str, Profile], figure: Figure) -> None:
    """Slope across the border of a ball, one plot for each set."""
    plots = figure.subplots(1, len(profiles), sharey=True, squeeze=False)[0]
    for axes, (title, profile) in zip(plots, profiles.items(), strict=True):
        axes.plot(PROFILE_RADII, profile.slope, color=series(0), label="slope of the gel")
        axes.plot(PROFILE_RADII, profile.ball, color=series(1), linestyle="--", label="slope of the ball")
        for number, (place, label) in enumerate(
            ((profile.core, "core: where the gel clings"), (profile.outline, "outline: outer edge")), 2
        ):
            axes.axvline(place, color=series(number), linestyle=":", label=label)
        axes.set(title=title, xlabel="distance / radius where the gel leaves the ball", ylim=(0, 1.15))
    plots[0].legend(loc="upper right")
    plots[0].set_ylabel("slope / largest slope")


def rows(names: Sequence[str], data: Path, profiles: dict[str, Profile]) -> Iterator[tuple[str, ...]]:
    """Rows of the table for sets that are there; profiles : those found are added."""
    for name in names:
        if not (data / JUDGED[name].folder).is_dir():
            say(f"{name}: not in {data}, left out")
            continue
        try:
            radii, profile, fitted = judge(JUDGED[name], data)
        except TactflowError as error:
            say(f"{name}: {str(error).splitlines()[0]}")
            continue
        if profile is not None:
            profiles[name] = profile
        yield row(name, radii, fitted)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab.judges.radius", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("sets", nargs="*", metavar="SET", help=f"default: {', '.join(JUDGED)}")
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="folder of the recordings")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="draw the slope across a ball's border")
    options = parser.parse_args(arguments)
    if unknown := set(options.sets) - set(JUDGED):
        parser.error(f"unknown set {', '.join(sorted(unknown))}; there are {', '.join(JUDGED)}")
    profiles: dict[str, Profile] = {}
    judged = list(rows(options.sets or list(JUDGED), options.data, profiles))
    print(*table([HEADING, *judged]), sep="\n")
    if options.picture is not None:
        drawn = {title: profiles[name] for name, title in PROFILE_SETS.items() if name in profiles}
        if not drawn:
            say(f"--picture: required one of the sets {', '.join(PROFILE_SETS)}")
            return 2
        save_plot(options.picture, lambda figure: draw(drawn, figure), width=760, height=280)
    return 0


if __name__ == "__main__":
    sys.exit(main())
