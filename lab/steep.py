"""Judge heights of steep and of cut-off objects on the simulator, where the surface of the gel is known.

    python -m lab.steep [--keep FOLDER]

Objects inside of the picture and at its border: greatest depth over the true one (5 %, median, 95 % of the
frames), RMS error within the contact, % of the depth, and RMS error of the greatest depth in stated ones (all
frames of a scene err alike). The edge of a cube, in light as it was calibrated with, and in
light in which a channel saturates: angle between its faces, of the gel's surface and of the heights.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import tactflow
from lab.pose import simulated_calibration
from tactflow.message.result import Result
from tactflow.sim import light, shapes
from tactflow.sim.gel import MM_PER_PX
from tactflow.sim.recipes import SCENES, Recipe
from tactflow.sim.truth import Truth

FRAMES = 120
MIN_DEPTH_MM = 0.1
"""True depth from which a frame counts, mm."""
PLACES = {
    "press": (0.99, 0.02),
    "cable": (0.9, 0.1),
    "box": (0.95, 0.5),
    "coin": (0.9, 0.5),
    "block": (0.9, 0.5),
}
"""Scene -> where it is pressed, parts of the picture's width and height."""
CUBE_DEPTH_PX = 36.0
"""Of the cube, raw px: its faces of 45 degrees are as wide."""
REST_GREY = (210.0, 165.0, 145.0)
"""Grey levels, BGR, of the untouched gel of `mini_box`, where up to half of a face is at 255."""
MIDDLE_SHARES = (0.2, 0.8)
"""Part of the width of a face that its angle is measured on."""


def frames(recipe: Recipe, calibration: Path) -> Iterator[tuple[Result, Truth]]:
    """Frames of a scene with a contact, and their truth."""
    SCENES["steep"] = recipe
    spec = f"steep?frames={FRAMES}&markers=none"
    scene, settings = tactflow.open_scene(spec), {"calibration": str(calibration)}
    for result in tactflow.stream("markerless", source=f"sim:{spec}", settings=settings):
        truth = scene.truth(result.seq, result["mapping"])
        if result.depth is not None and truth.sunk.max() * MM_PER_PX > MIN_DEPTH_MM:
            yield result, truth


def judge(recipe: Recipe, calibration: Path) -> str:
    """The columns of an object."""
    ratios, errors, stated = [], [], []
    for result, truth in frames(recipe, calibration):
        assert result.depth is not None
        assert result.depth.greatest_stderr is not None
        true = truth.sunk * MM_PER_PX
        ratios.append(result.depth.greatest / true.max())
        off = (result.depth.heights - true)[truth.contact_mask]
        errors.append(np.sqrt(np.mean(off**2)) / true.max())
        stated.append((result.depth.greatest - true.max()) / result.depth.greatest_stderr)
    low, median, high = np.percentile(ratios, [5, 50, 95])
    rms = np.sqrt(np.mean(np.square(stated)))
    return f"{low:5.2f} {median:5.2f} {high:5.2f} {100 * np.median(errors):6.1f} {rms:6.1f}"


def cube(level: tuple[float, float, float], calibration: Path) -> str:
    """Angles between the faces of a cube's edge. level : grey levels of the untouched gel, BGR."""
    recipe, usual = SCENES["edge"], light.LIGHTS["photometric"]
    assert recipe.programme is not None
    edge = partial(shapes.edge, half_length=200.0, slope=1.0, depth=CUBE_DEPTH_PX)
    programme = replace(recipe.programme, indenters=(edge,), wander=(0.0, 0.0), angles=(0.0, 0.0))
    light.LIGHTS["photometric"] = replace(usual, level=level)
    try:
        deepest, truth = max(
            frames(recipe._replace(programme=programme), calibration), key=lambda pair: pair[1].depth
        )
    finally:
        light.LIGHTS["photometric"] = usual
    assert deepest.depth is not None
    true, found = (angle(part, truth) for part in (truth.sunk * MM_PER_PX, deepest.depth.heights))
    return f"{found:.0f} degrees between its faces, the gel's surface {true:.0f}"


def angle(heights: NDArray[np.floating], truth: Truth) -> float:
    """Degrees between the faces of an edge that lies along the picture's longer side of the contact."""
    rows, columns = np.nonzero(truth.contact_mask)
    if np.ptp(rows) > np.ptp(columns):
        heights, rows, columns = heights.T, columns, rows
    middle, half = int(columns.mean()), int(np.ptp(columns) / 4)
    profile = heights[:, middle - half : middle + half].mean(axis=1)
    across = 2 * (np.arange(len(profile)) - rows.mean()) / truth.depth
    bends = []
    for side in (-1, 1):
        face = (side * across > MIDDLE_SHARES[0]) & (side * across < MIDDLE_SHARES[1])
        slope = np.polyfit(np.flatnonzero(face) * 2 * MM_PER_PX, profile[face], 1)[0]
        bends.append(np.degrees(np.arctan(abs(slope))))
    return float(180 - sum(bends))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="judge heights of steep and cut-off objects")
    parser.add_argument("--keep", type=Path, help="folder with the calibration of an earlier run")
    args = parser.parse_args()
    keep = args.keep or Path(tempfile.mkdtemp())
    calibration = simulated_calibration(keep)
    for name, place in PLACES.items():
        recipe = SCENES[name]
        assert recipe.programme is not None
        cut = recipe._replace(programme=replace(recipe.programme, place=place, wander=(0.0, 0.0)))
        print(f"{name:24} {judge(recipe, calibration)}", flush=True)
        print(f"{name + ' at the border':24} {judge(cut, calibration)}", flush=True)
    usual = light.LIGHTS["photometric"].level
    for label, level in (("edge of a cube", usual), ("... bright light", REST_GREY)):
        print(f"{label:24} {cube(level, calibration)}", flush=True)


if __name__ == "__main__":
    main()
