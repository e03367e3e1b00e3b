"""The tables of calibration.md: errors of height maps, of simulated contacts and of a real ball.

python docs/depth_table.py            simulated contacts under three lights; a minute
python docs/depth_table.py bound      what is left where the slopes are true, as far as the ball showed them
python docs/depth_table.py cost       time of a height map, and of its parts; wants a quiet machine
python docs/depth_table.py FOLDER     wedge_ball, in the folder that has its pictures and labels.csv
"""

from __future__ import annotations

import csv
import sys
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.depth import (
    LIGHTS,
    RAW_MM,
    WEDGE_BALL,
    WEDGE_SCALE,
    deepest,
    learn,
    noisy,
    scale,
)
from tactflow.bench.pipelines import on_recording
from tactflow.bench.recordings import stack
from tactflow.bench.timing import BLOCK, CopyUnit, interleaved
from tactflow.calibration.photometric import fit_photometry, fit_sphere
from tactflow.calibration.presses import find_presses
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.sim import open_scene
from tactflow.vision.depth.poisson import integrate
from tactflow.vision.depth.slopes import SlopeModel, coordinates
from tactflow.vision.depth.surface import Rest, Surface, colour_change
from tactflow.vision.depth.surroundings import Surroundings, surroundings
from tactflow.vision.geometry import Preprocessor

Values = NDArray[np.float64]

SCENES = ("press", "finger", "cable", "bent_cable", "long_edge", "box", "coin", "two", "screw")
SHARP = {"long_edge", "box", "coin"}
"""What has edges."""
SEEDS = (12, 13)
"""No constant of the errors was chosen on these; how the calibration is smoothed was, with a look at them."""
CONTACTS = 3
"""Of each recording, the first ones at their deepest."""
INNER, OUTER = 0.85, 0.8
"""Part of a contact's radius in which normals are judged, and of the ball's in which heights are."""


@dataclass
class Tally:
    """Errors of one scene under one light. rms : % of the greatest depth. depth, volume : in stated ones."""

    rms: list[float] = field(default_factory=list)
    depth: list[float] = field(default_factory=list)
    volume: list[float] = field(default_factory=list)

    def add(
        self, found: Surface, rest: Rest, image: NDArray[np.uint8], mask: NDArray[np.uint8], true: Values
    ) -> None:
        """One contact. true : (H, W), mm."""
        seen = found.depth(image, rest, mask)
        around = true > 0.02 * true.max()
        self.rms.append(100 * float(np.sqrt(np.mean((seen.heights - true)[around] ** 2)) / true.max()))
        volume = float(true.sum()) * scale().area(1.0)
        assert seen.greatest_stderr is not None
        assert seen.volume_stderr is not None
        self.depth.append(abs(seen.greatest - float(true.max())) / seen.greatest_stderr)
        self.volume.append(abs(seen.volume - volume) / seen.volume_stderr)


def simulated() -> None:
    """Print the table of the simulated contacts, and how many errors are within the stated ones."""
    tallies: dict[tuple[str, str], Tally] = {}
    for light in LIGHTS:
        known = learn(f"ball?frames=600&light={light}")
        surface = Surface(known.model, scale(), known.found.errors())
        for name in SCENES:
            tallies[light, name] = tried(surface, name, light)
        row = " | ".join(f"{np.mean(tallies[light, name].rms):.1f}" for name in SCENES)
        print(f"| `{light}` | {row} |", flush=True)
    for what, names in (("all", set(SCENES)), ("round", set(SCENES) - SHARP), ("sharp", SHARP)):
        chosen = [tally for (_, name), tally in tallies.items() if name in names]
        shares = [
            100 * np.mean(np.concatenate([getattr(tally, part) for tally in chosen]) < bound)
            for part in ("depth", "volume")
            for bound in (1, 2)
        ]
        count = sum(len(tally.depth) for tally in chosen)
        print(f"| {what} | {count} | " + " | ".join(f"{share:.0f}" for share in shares) + " |")


def tried(surface: Surface, name: str, light: str) -> Tally:
    """The errors on one scene under one light."""
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    tally = Tally()
    for seed in SEEDS:
        scene = open_scene(f"{name}?seed={seed}&light={light}")
        rest = Rest(scene.truth(0, preprocess).unmarked)
        for index in deepest(scene)[:CONTACTS]:
            truth = scene.truth(index, preprocess)
            mask: NDArray[np.uint8] = np.uint8(255) * truth.contact_mask
            tally.add(
                surface, rest, noisy(truth.unmarked, index), mask, truth.sunk.astype(np.float64) * RAW_MM
            )
    return tally


def bound() -> None:
    """Print errors of heights that are integrals of the true slopes, in % of the greatest depth.

    One row with all slopes, one with those cut that are steeper than the calibration's ball has shown.
    """
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    steepest = learn("ball?frames=600").found.steepest
    assert steepest is not None
    for most in (1.0, steepest):
        row = []
        for name in SCENES:
            errors = []
            for seed in SEEDS:
                scene = open_scene(f"{name}?seed={seed}")
                rest = Rest(scene.truth(0, preprocess).unmarked)
                for index in deepest(scene)[:CONTACTS]:
                    truth = scene.truth(index, preprocess)
                    around = surroundings(np.uint8(255) * truth.contact_mask, rest.window)
                    errors.append(integrated(truth.sunk.astype(np.float64) * RAW_MM, around, most))
            row.append(f"{np.mean(errors):.1f}")
        print(f"| {most:.2f} | " + " | ".join(row) + " |", flush=True)


def integrated(true: Values, around: Surroundings, most: float) -> float:
    """RMS error of the heights from the true slopes of a surface (H, W), mm, in % of the greatest depth.

    most : horizontal part of a unit normal from which on slopes are cut.
    """
    down, across = np.gradient(true, 2 * RAW_MM)
    length = np.hypot(down, across)
    cut = np.minimum(1, most / np.sqrt(np.maximum(1 - most**2, 1e-9)) / np.maximum(length, 1e-9))
    slopes = [
        cv2.resize((part * cut)[around.window.whole], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for part in (across, down)
    ]
    low = integrate(np.asarray(slopes, np.float32), (4 * RAW_MM, 4 * RAW_MM))
    low -= np.median(np.concatenate([low[0], low[-1], low[:, 0], low[:, -1]]))
    found = np.zeros(true.shape)
    rows, columns = around.window.whole
    found[rows, columns] = cv2.resize(
        np.maximum(low, 0), (columns.stop - columns.start, rows.stop - rows.start)
    )
    sunk = true > 0.02 * true.max()
    return 100 * float(np.sqrt(np.mean((found - true)[sunk] ** 2)) / true.max())


def cost() -> None:
    """Print what a height map costs: copies of a raw frame in the median, and the parts of that time, %.

    Of each scene the contacts at their deepest, each one 20 times in a row, as frames follow each other.
    """
    known = learn("ball?frames=600")
    surface = Surface(known.model, scale(), known.found.errors())
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    unit = CopyUnit()
    parts = {"all": Contact.depth, "where": Contact.where, "colour": Contact.colour}
    parts |= {"slopes": Contact.slopes, "heights": Contact.heights}
    for name in SCENES:
        scene = open_scene(f"{name}?seed={SEEDS[0]}")
        rest = Rest(scene.truth(0, preprocess).unmarked)
        contacts = []
        for index in deepest(scene)[:CONTACTS]:
            truth = scene.truth(index, preprocess)
            mask: NDArray[np.uint8] = np.uint8(255) * truth.contact_mask
            contacts.append(Contact(surface, known.model, rest, noisy(truth.unmarked, index), mask))
        unit.take(BLOCK)
        times = interleaved(parts, [(name, contact) for contact in contacts for _ in range(BLOCK)])
        ms = {part: 1e3 * float(np.median(found[name].cpu)) for part, found in times.items()}
        size = " x ".join(str(side) for side in np.median([c.size for c in contacts], axis=0).astype(int))
        shares = " | ".join(f"{100 * ms[part] / ms['all']:.0f}" for part in list(parts)[1:])
        print(f"| {name} | {size} | {ms['all'] / unit.copy_ms:.1f} | {shares} |", flush=True)
    print(f"a copy: {unit.copy_ms:.3f} ms")


class Contact:
    """What the height map of a contact is made of, step by step."""

    def __init__(
        self,
        surface: Surface,
        model: SlopeModel,
        rest: Rest,
        image: NDArray[np.uint8],
        mask: NDArray[np.uint8],
    ) -> None:
        self._surface, self._model = surface, model
        self._rest, self._image, self._mask = rest, image, mask
        self._around = surroundings(mask, rest.window)
        window = self._around.window
        self.size = window.width, window.height
        x, y = coordinates((rest.window.width, rest.window.height))
        self._places = x[window.part[1]], y[window.part[0]]
        self._change = colour_change(image, rest, window)
        self._slope = self.slopes()

    def depth(self) -> object:
        return self._surface.depth(self._image, self._rest, self._mask)

    def where(self) -> object:
        return surroundings(self._mask, self._rest.window)

    def colour(self) -> object:
        return colour_change(self._image, self._rest, self._around.window)

    def slopes(self) -> NDArray[np.float32]:
        return self._model.slopes(self._change, *self._places, self._around.near)

    def heights(self) -> object:
        return integrate(self._slope, (-0.1, -0.1))


class Ball:
    """Presses of wedge_ball, each judged by what was learned from the other half.

    folder : of the pictures. labels : (N, 3), x, y and radius, px.
    """

    def __init__(self, folder: Path) -> None:
        with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        self.labels = np.array([[float(row[key]) for key in ("x", "y", "radius")] for row in rows])
        with tempfile.TemporaryDirectory() as scratch:
            files = [folder / "reference.jpg", *(folder / row["file"] for row in rows)]
            pipeline = load_pipeline(find_pipeline("wedge"))
            self.session = find_presses(on_recording(pipeline, stack(files, Path(scratch))))
        self.rest = Rest(self.session.untouched)
        self.all = fit_photometry(self.session, WEDGE_SCALE, WEDGE_BALL)
        presses = self.session.presses
        labelled = self.labels[[press.seq - 1 for press in presses]]
        self.offset = np.median((self.all.centers - labelled[:, :2])[self.all.kept], axis=0)

    def print(self) -> None:
        """Print the rows of the table."""
        good = np.flatnonzero(self.all.kept)
        tried = []
        for learned, others in ((good[::2], good[1::2]), (good[1::2], good[::2])):
            half = replace(self.session, presses=[self.session.presses[i] for i in learned])
            model = fit_photometry(half, WEDGE_SCALE, WEDGE_BALL).model
            tried += [self.errors(model, int(i)) for i in others]
        inner, disc, labelled, radius, rms = np.array(tried).T
        print(f"presses: {len(self.session.presses)} found, {len(good)} kept")
        print(f"normals: {inner.mean():.1f} degrees; over the whole disc {disc.mean():.1f}")
        print(f"normals from the labels: {labelled.mean():.1f} degrees")
        low, middle, high = 100 * np.percentile(radius, (10, 50, 90))
        print(f"radius of the sphere: median {middle:+.1f} %, 10 to 90 % from {low:+.1f} to {high:+.1f} %")
        print(f"heights from the sphere, RMS: {rms.mean():.3f} mm")

    def errors(self, model: SlopeModel, index: int) -> list[float]:
        """Angles of the normals inside, over the disc, from the label; radius and RMS of the sphere."""
        press, middle = self.session.presses[index], self.all.centers[index]
        label = self.labels[press.seq - 1]
        around = surroundings(press.mask, self.rest.window)
        x, y = coordinates((self.rest.window.right, self.rest.window.bottom))
        rows, columns = around.window.part
        change = colour_change(press.image, self.rest, around.window)
        everywhere = np.ones(change.shape[:2], np.uint8)
        slope = model.slopes(change, x[columns], y[rows], everywhere)
        normal = slope / np.sqrt(1 + (slope**2).sum(axis=0))
        heights = Surface(model, WEDGE_SCALE).heights(press.image, self.rest, around)
        rows, columns = np.mgrid[around.window.part]
        points = np.stack([2 * columns + 0.5, 2 * rows + 0.5], axis=-1)
        hidden = press.hidden[around.window.whole][::2, ::2]
        ball = WEDGE_BALL / WEDGE_SCALE.x
        angles = []
        for center, reach in (
            (middle, INNER * min(press.radius, ball)),
            (middle, label[2]),
            (label[:2] + self.offset, label[2]),
        ):
            away = points - center
            distance = np.hypot(away[..., 0], away[..., 1])
            inside = ~hidden & (distance < min(reach, ball))
            angles.append(angle(normal, away, ball, inside))
        away = points - middle
        cap = np.hypot(away[..., 0], away[..., 1]) <= OUTER * ball
        surface = np.column_stack([away[cap] * WEDGE_SCALE.x, heights[cap].astype(np.float64)])
        radius, rms = fit_sphere(surface)
        return [*angles, radius / WEDGE_BALL - 1, rms]


def angle(normal: NDArray[np.float32], away: Values, ball: float, where: NDArray[np.bool_]) -> float:
    """Mean angle between normals (2, h, w) and those of a ball, degrees. away : (h, w, 2), px."""
    vectors = [upright(normal.transpose(1, 2, 0)[where].astype(np.float64)), upright(away[where] / ball)]
    return float(np.degrees(np.arccos(np.clip((vectors[0] * vectors[1]).sum(axis=1), -1, 1))).mean())


def upright(flat: Values) -> Values:
    """(n, 3) unit normals from their horizontal parts (n, 2)."""
    return np.column_stack([flat, np.sqrt(np.maximum(1 - (flat**2).sum(axis=1), 0))])


if __name__ == "__main__":
    cv2.setNumThreads(1)
    if sys.argv[1:] == ["bound"]:
        bound()
    elif sys.argv[1:] == ["cost"]:
        cost()
    elif len(sys.argv) > 1:
        Ball(Path(sys.argv[1])).print()
    else:
        simulated()
