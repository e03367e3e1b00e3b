"""What the indenters do: programmes of press, hold and release, random but reproducible.

Frame 0 and the first tenth of a recording, at most two seconds, show the untouched gel, and so do its last
frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tactflow.sim.gel import Press
from tactflow.sim.shapes import Shape

_LONGEST_REST = 120
_LARGEST_CREEP = 60.0


@dataclass(frozen=True)
class Programme:
    """A series of contacts; lengths of time are in frames.

    build : makes the indenter(s). offsets : where each of them sits, px.
    period : from one contact to the next. rise : from touch to full depth, and back. hold : time at depth.
    depths : relative depth of successive contacts. place : their mean position as a fraction of the frame;
    wander : how far from it they may be, px. angles : range of the indenter's angle, degrees.
    travel : px by which the indenter slides during a hold. jumps : if true, the gel is dragged to a new place
    every third frame. creep : px per frame by which the gel is dragged. dilation : pitches by which a press
    pushes the gel apart. single : one contact that lasts as long as the recording.
    """

    build: Callable[[float], tuple[Shape, ...]]
    offsets: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    period: int = 60
    rise: int = 10
    hold: int = 24
    depths: tuple[float, ...] = (1.0, 0.5, 0.8, 0.35, 0.65)
    place: tuple[float, float] = (0.5, 0.5)
    wander: tuple[float, float] = (190.0, 120.0)
    angles: tuple[float, float] = (0.0, 0.0)
    travel: float = 0.0
    jumps: bool = False
    creep: float = 0.0
    dilation: float = 0.3
    single: bool = False


@dataclass(frozen=True, slots=True)
class _Plan:
    x: float
    y: float
    angle: float
    direction: float
    sign: float
    depth: float


@lru_cache(maxsize=256)
def _plan(programme: Programme, seed: int, cycle: int, size: tuple[int, int]) -> _Plan:
    rng = np.random.default_rng([seed, cycle, 0x6D6F])
    x = size[0] * programme.place[0] + programme.wander[0] * rng.uniform(-1, 1)
    y = size[1] * programme.place[1] + programme.wander[1] * rng.uniform(-1, 1)
    angle = (
        float(np.radians(rng.uniform(*programme.angles)))
        if programme.angles[0] != programme.angles[1]
        else 0.0
    )
    direction = float(rng.uniform(0, 2 * np.pi))
    if programme.travel:
        # Slide across the middle of the gel, not out of it.
        direction = float(np.arctan2(size[1] * programme.place[1] - y, size[0] * programme.place[0] - x))
    depth = programme.depths[cycle % len(programme.depths)]
    return _Plan(float(x), float(y), angle, direction, -1.0 if cycle % 2 else 1.0, depth)


def _smooth(value: float) -> float:
    value = min(max(value, 0.0), 1.0)
    return value * value * (3.0 - 2.0 * value)


def presses(
    programme: Programme,
    shapes: tuple[Shape, ...],
    moment: int,
    frames: int,
    *,
    seed: int,
    size: tuple[int, int],
    pitch: float,
    depth: float,
    shear: float,
    twist: float,
    sink: float,
    rim: float,
) -> tuple[tuple[Press, ...], int]:
    """The indenters at one moment, and the number of the contact they belong to (-1 between contacts).

    moment : frame of the scene. frames : its length. depth : scales all depths. shear : pitches by which the
        gel is dragged at most. twist : degrees by which it is turned at most.
    sink, rim : of the gel, see `Press`.
    """
    start = min(max(1, round(0.1 * frames)), _LONGEST_REST)
    usable = frames - start - max(1, frames // 30)
    if moment < start or usable < 1:
        return (), -1
    cycles = 1 if programme.single else max(1, usable // programme.period)
    # A recording shorter than one contact shows a faster one.
    stretch = usable / programme.period if programme.single or usable < programme.period else 1.0
    period = programme.period * stretch
    rise, hold = programme.rise * stretch, max(programme.hold * stretch, 1.0)
    elapsed = moment - start
    cycle = int(elapsed // period)
    if cycle >= cycles:
        return (), -1
    phase = elapsed - cycle * period
    if phase >= 2 * rise + hold:
        return (), -1
    plan = _plan(programme, seed, cycle, size)
    if phase < rise:
        envelope = _smooth((phase + 1.0) / (rise + 1.0))
    elif phase < rise + hold:
        envelope = 1.0
    else:
        envelope = _smooth((2 * rise + hold - phase) / (rise + 1.0))
    progress = min(max((phase - rise) / hold, 0.0), 1.0)
    ahead = np.array([np.cos(plan.direction), np.sin(plan.direction)])
    drag = np.zeros(2)
    travelled = np.zeros(2)
    if programme.jumps:
        draw = np.random.default_rng([seed, cycle, int(phase // 3), 0x6A75])
        angle, radius = draw.uniform(0, 2 * np.pi), 0.45 * pitch * np.sqrt(draw.uniform(0.3, 1))
        drag = radius * np.array([np.cos(angle), np.sin(angle)])
        travelled = drag
    elif programme.creep:
        # To and fro, so that the contact stays on the gel however long the recording is.
        way = programme.creep * max(phase - rise, 0.0) % (2 * _LARGEST_CREEP)
        drag = travelled = (_LARGEST_CREEP - abs(way - _LARGEST_CREEP)) * ahead
    elif programme.travel:
        # Stick until the gel has been dragged as far as friction holds it, then slip.
        way = programme.travel * progress
        drag = min(way, shear * pitch) * ahead
        travelled = way * ahead
    elif shear:
        drag = travelled = shear * pitch * float(np.sin(np.pi * _smooth(progress))) * ahead
    turn = np.radians(twist) * plan.sign * float(np.sin(np.pi * _smooth(progress)))
    made = []
    for shape, (offset_x, offset_y) in zip(shapes, programme.offsets, strict=True):
        made.append(
            Press(
                shape,
                plan.x + offset_x + float(travelled[0]),
                plan.y + offset_y + float(travelled[1]),
                plan.angle + float(turn),
                envelope * plan.depth * depth * shape.depth,
                (float(drag[0]), float(drag[1])),
                float(turn),
                programme.dilation * pitch,
                sink,
                rim,
            )
        )
    return tuple(made), cycle
