"""Judge whether `calibrate` accepts balls and nothing else.

    python -m lab.not_balls [--data ../shared/data] [--keep FOLDER] [--few]

Things that are no ball, or a ball with a wrong scale or radius: simulated ones, with their true outlines, and
edges of a cube; each must be refused, or the question about the radius asked where only it is wrong and
geometry cannot tell. Balls on real sensors must be accepted, with all their presses and (`--few`) with nine.
Columns: name, verdict, why.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lab.depth import EDGE, SETS, Balls, read, scale_of
from tactflow.calibration.judgement import doubt
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.scale import centre
from tactflow.engine.errors import ConfigError
from tactflow.sim import Scene, open_scene, shapes
from tactflow.sim.gel import MM_PER_PX
from tactflow.sim.motion import Programme
from tactflow.sim.shapes import Shape
from tactflow.system.terminal import show, table
from tactflow.vision.arrays import Floats32
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

RADIUS = 95 * MM_PER_PX
"""Radius of the simulated ball, mm."""
FEW = 9
"""Presses of a short session."""
REAL = {
    **SETS,
    "mini_ball_4mm": Balls("mini_ball_4mm", "000.png", "mini_plain", 0.08, {"": 2.0}),
    "digit_ball": Balls("digit_ball", "000.png", "digit", 1 / 18.68, {"": 4.4}),
    "gelslim_ball": Balls("gels/gelslim_ball", "000.jpg", "gelslim", 0.06, {"": 3.0}),
}
"""Presses of real balls. The scale and the radius of the last are not known; their ratio is plausible."""


def _shape(gap: Callable[[Floats32, Floats32], Floats32]) -> Callable[[], Shape]:
    """Makes a small indenter. gap : x, y, px -> height of its surface above the lowest point, px."""
    return lambda: Shape(lambda x, y: np.asarray(gap(x, y), np.float32), 160.0, 22.0, np.zeros((1, 2)), 60.0)


def _ellipsoid(across: float, along: float) -> Callable[[], Shape]:
    """Radii of curvature, px."""
    return _shape(lambda x, y: (x * x / across + y * y / along) / 2)


def _spheres(*middles: tuple[float, float]) -> Callable[[], Shape]:
    """Balls side by side."""
    return _shape(lambda x, y: np.min([(x - a) ** 2 + (y - b) ** 2 for a, b in middles], axis=0) / 110)


def _corner(x: Floats32, y: Floats32) -> Floats32:
    """The corner of a cube, upside down."""
    return np.asarray(0.7 * np.maximum(np.maximum(x, 0.866 * y - 0.5 * x), -0.866 * y - 0.5 * x), np.float32)


def _cross(x: Floats32, y: Floats32) -> Floats32:
    """Two bars."""
    bars = [np.maximum(abs(a) - 70, 0) + np.maximum(abs(b) - 18, 0) for a, b in ((x, y), (y, x))]
    return np.asarray(np.minimum(*bars), np.float32)


NOT_BALLS: dict[str, Callable[[], Shape]] = {
    "cone": _shape(lambda x, y: 0.6 * np.hypot(x, y)),
    "truncated cone": _shape(lambda x, y: np.maximum(0.7 * np.hypot(x, y) - 12, 0)),
    "pyramid": _shape(lambda x, y: 0.6 * np.maximum(abs(x), abs(y))),
    "corner of a cube": _shape(_corner),
    "end of a cylinder": _shape(lambda x, y: 2 * np.maximum(np.hypot(x, y) - 55, 0)),
    "end with a rounded edge": _shape(lambda x, y: np.maximum(np.hypot(x, y) - 40, 0) ** 2 / 40),
    "ellipsoid 1.5 : 1": _ellipsoid(75, 115),
    "ellipsoid 2 : 1": _ellipsoid(70, 140),
    "ellipsoid 3 : 1": _ellipsoid(50, 150),
    "cylinder": shapes.cable,
    "short cylinder": partial(shapes.cable, radius=70.0, half_length=40.0, depth=22.0),
    "ring": shapes.ring,
    "coin": shapes.coin,
    "box": shapes.box,
    "square punch": partial(shapes.box, half_width=55.0, half_height=55.0),
    "knife edge": shapes.edge,
    "screw": shapes.screw,
    "finger": shapes.finger,
    "grooved block": shapes.block,
    "cross": _shape(_cross),
    "bowl": _shape(lambda x, y: (np.hypot(x, y) - 45) ** 2 / 90),
    "two balls": _spheres((-50, 0), (50, 0)),
    "three balls": _spheres((50, 0), (-30, 45), (-30, -45)),
}
"""Simulated things."""
TURNED = ("ellipsoid 2 : 1", "ellipsoid 3 : 1", "cylinder", "short cylinder", "knife edge", "two balls")
"""Those that are also pressed in all directions; the others only in one."""


def simulated(make: Callable[[], Shape], turned: bool = False) -> Session:
    """Presses of a thing all over the gel, with their true outlines and without markers."""
    angles = (-90.0, 90.0) if turned else (0.0, 0.0)
    programme = Programme(
        (make,), wander=(300, 210), period=20, rise=4, hold=10, depths=(1, 0.8, 0.9, 0.6), angles=angles
    )
    scene = Scene("thing", programme, open_scene("ball?frames=300").settings)
    preprocess = Preprocessor((800, 600), rotate=90, downsample=2)
    depths = [max((press.depth for press in scene.presses(i)), default=0.0) for i in range(len(scene))]
    presses = []
    for index in range(1, len(scene) - 1):
        if not depths[index - 1] < depths[index] >= depths[index + 1]:
            continue
        truth = scene.truth(index, preprocess)
        mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
        radius = float(np.sqrt(np.count_nonzero(mask) / np.pi))
        noise = np.random.default_rng(index).normal(0, 1, (*mask.shape, 3))
        image = np.clip(np.rint(preprocess(scene.clean(index)) + noise), 0, 255).astype(np.uint8)
        middle = truth.center or (0.0, 0.0)
        presses.append(Press(index, image, mask, np.zeros(mask.shape, np.bool_), middle, radius))
    return Session(preprocess(scene.clean(0)), preprocess.mapping, presses, np.zeros((0, 2)), len(scene))


def verdict(session: Session, scale: Scale, radii: float | list[float]) -> tuple[str, str]:
    """Accepted, asked or refused, and why."""
    try:
        fit_photometry(session, scale, radii)
    except ConfigError as problem:
        return "refused", str(problem).removeprefix("calibrate: ")
    question = doubt(session, scale, float(np.median(radii)))
    return ("asked", question) if question else ("accepted", "")


def wrong_things(edges: Session | None) -> Iterator[tuple[str, tuple[str, str]]]:
    """Name and verdict of what must not be accepted silently."""
    for name, make in NOT_BALLS.items():
        session = simulated(make)
        scale = Scale(2 * MM_PER_PX, 2 * MM_PER_PX, (0.0, 0.0), centre(session.mapping.size))
        yield name, verdict(session, scale, RADIUS)
        if name in TURNED:
            yield f"{name}, turned", verdict(simulated(make, turned=True), scale, RADIUS)
    ball = simulated(shapes.ball)
    scale = Scale(2 * MM_PER_PX, 2 * MM_PER_PX, (0.0, 0.0), centre(ball.mapping.size))
    for name, across, down in (
        ("--area swapped (1.78 : 1)", 4 / 3, 3 / 4),
        ("width 20 % too large", 1.2, 1.0),
        ("height 20 % too large", 1.0, 1.2),
    ):
        stretched = replace(scale, x=across * scale.x, y=down * scale.y)
        yield name, verdict(ball, stretched, RADIUS)
    yield "the diameter", verdict(ball, scale, 2 * RADIUS)
    yield "a third of the radius", verdict(ball, scale, RADIUS / 3)
    if edges is not None:
        yield "edges of a cube (real)", verdict(edges, scale_of(EDGE, edges), 2.5)


def main() -> None:
    """Print what is accepted."""
    parser = argparse.ArgumentParser(description="judge what calibrate accepts as a ball")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder with the presses of an earlier run of lab/depth.py")
    parser.add_argument("--few", action="store_true", help=f"also judge {FEW} presses of each real ball")
    args = parser.parse_args()

    def presses(name: str, balls: Balls) -> tuple[Session, list[str]]:
        kept = args.keep / f"{name}.pickle" if args.keep else None
        if kept and kept.exists():
            session: tuple[Session, list[str]] = pickle.loads(kept.read_bytes())
            return session
        return read(balls, args.data)

    rows = [["no ball", "verdict", "why"]]
    rows += [[name, *found] for name, found in wrong_things(presses("edge", EDGE)[0])]
    accepted = sum(row[1] == "accepted" for row in rows)
    show([*table(rows), "", f"accepted: {accepted} of {len(rows) - 1}", ""])
    rows = [["ball", "verdict", "why"]]
    for name, balls in REAL.items():
        session, names = presses(name, balls)
        radii = [next(r for start, r in balls.radii.items() if file.startswith(start)) for file in names]
        scale = scale_of(balls, session)
        rows.append([name, *verdict(session, scale, radii)])
        if args.few:
            chosen = np.linspace(0, len(names) - 1, FEW).astype(int).tolist()
            few = replace(session, presses=[session.presses[i] for i in chosen])
            rows.append([f"{name}, {FEW} presses", *verdict(few, scale, [radii[i] for i in chosen])])
    refused = sum(row[1] == "refused" for row in rows)
    show([*table(rows), "", f"refused: {refused} of {len(rows) - 1}"])


if __name__ == "__main__":
    main()
