"""What the indenters do: programmes of press, hold and release, random but reproducible.

Frame 0 and the first tenth of a recording, at most two seconds, show the untouched gel, and so do its last
frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tactflow.sim.gel import Press
from tactflow.sim.settings import Settings
from tactflow.sim.shapes import Shape

_REST = 0.1
"""Part of a recording at its start in which nothing touches the gel; chosen by hand."""

_LONGEST_REST = 120
"""The same at most, frames: 2 s at 60 frames a second."""

_LAST_REST = 30
"""One frame of so many is left untouched at the end of a recording; chosen by hand."""

_FULL_LOAD = 0.75
"""Part of a hold after which a ball that slips at the edge first slips altogether. Chosen by hand."""

_LARGEST_CREEP = 60.0
"""Farthest that a creeping gel is dragged before it turns back, px; chosen by hand."""

_LARGEST_STROKE = 110.0
"""Contacts move the gel in proportion to the markers' pitch, up to this pitch, px. Chosen by hand."""

_LARGEST_JUMP = 0.45
"""Farthest that a jumping gel is from its middle, pitches: jumps of up to 0.9 pitches from place to place."""


@dataclass(frozen=True)
class Programme:
    """A series of contacts; lengths of time are in frames.

    build : makes the indenter(s). offsets : where each of them sits, px.
    period : from one contact to the next. rise : from touch to full depth, and back. hold : time at depth.
    depths : relative depth of successive contacts. place : their mean position as a fraction of the frame;
    wander : how far from it they may be, px. angles : range of the indenter's angle, degrees.
    travel : px by which the indenter slides during a hold. jumps : if true, the gel is dragged to a new place
    every third frame. creep : px per frame by which the gel is dragged. dilation : pitches by which a press
    pushes the gel apart. contacts : so many that share the length of the recording; 0: as many as fit.
    partial : whether the gel begins to slip at the edge of the contact before all of it does; for balls.
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
    contacts: int = 0
    partial: bool = False


@dataclass(frozen=True, slots=True)
class _Plan:
    x: float
    y: float
    angle: float
    direction: float
    sign: float
    depth: float

    @property
    def ahead(self) -> NDArray[np.float64]:
        """Unit vector (2,) of the direction of motion."""
        return np.array([np.cos(self.direction), np.sin(self.direction)])


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


@dataclass(frozen=True, slots=True)
class _Timing:
    """Where in its contacts a programme is.

    cycle : number of the contact. phase : frames since it began. rise : frames from touch to full depth.
    envelope : depth now over full depth, 0 to 1. progress : part of the hold that is over, 0 to 1.
    """

    cycle: int
    phase: float
    rise: float
    envelope: float
    progress: float


def _timing(programme: Programme, moment: int, frames: int) -> _Timing | None:
    """The contact at a frame of a recording of so many frames; None where nothing touches the gel."""
    start = min(max(1, round(_REST * frames)), _LONGEST_REST)
    usable = frames - start - max(1, frames // _LAST_REST)
    if moment < start or usable < 1:
        return None
    cycles = programme.contacts or max(1, usable // programme.period)
    # A recording shorter than one contact shows a faster one.
    fitted = programme.contacts > 0 or usable < programme.period
    stretch = usable / (programme.period * cycles) if fitted else 1.0
    period = programme.period * stretch
    rise, hold = programme.rise * stretch, max(programme.hold * stretch, 1.0)
    elapsed = moment - start
    cycle = int(elapsed // period)
    phase = elapsed - cycle * period
    if cycle >= cycles or phase >= 2 * rise + hold:
        return None
    if phase < rise:
        envelope = _smooth((phase + 1.0) / (rise + 1.0))
    elif phase < rise + hold:
        envelope = 1.0
    else:
        envelope = _smooth((2 * rise + hold - phase) / (rise + 1.0))
    return _Timing(cycle, phase, rise, envelope, min(max((phase - rise) / hold, 0.0), 1.0))


def _jump(timing: _Timing, seed: int, pitch: float) -> NDArray[np.float64]:
    """Displacement (2,), px, drawn anew every third frame: up to 0.45 pitches from the middle."""
    draw = np.random.default_rng([seed, timing.cycle, int(timing.phase // 3), 0x6A75])
    angle, radius = draw.uniform(0, 2 * np.pi), _LARGEST_JUMP * pitch * np.sqrt(draw.uniform(0.3, 1))
    return np.asarray(radius * np.array([np.cos(angle), np.sin(angle)]))


def _creep(programme: Programme, timing: _Timing) -> float:
    """How far the gel has been dragged, px: to and fro, so that the contact stays on it for ever."""
    way = programme.creep * max(timing.phase - timing.rise, 0.0) % (2 * _LARGEST_CREEP)
    return _LARGEST_CREEP - abs(way - _LARGEST_CREEP)


def _dragged(
    programme: Programme, timing: _Timing, plan: _Plan, seed: int, pitch: float, shear: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float | None, bool]:
    """How far the gel is dragged and the indenter has travelled, (2,) px; `stick`, `sliding` of `Press`."""
    ahead = plan.ahead
    farthest = shear * pitch
    if programme.jumps:
        drag = _jump(timing, seed, pitch)
        return drag, drag, None, False
    if programme.creep:
        drag = _creep(programme, timing) * ahead
        return drag, drag, None, False
    if programme.partial:
        load = timing.progress / _FULL_LOAD
        stick = max(1.0 - load, 0.0) ** (1 / 3)
        drag = farthest * (1 - stick**2) * ahead
        beyond = programme.travel * max(timing.progress - _FULL_LOAD, 0.0)
        return drag, drag + beyond * ahead, stick, load > 1 and timing.progress < 1
    if programme.travel:
        # Stick until the gel has been dragged as far as friction holds it, then slip.
        way = programme.travel * timing.progress
        return min(way, farthest) * ahead, way * ahead, None, 0 < farthest < way and timing.progress < 1
    swing = float(np.sin(np.pi * _smooth(timing.progress)))
    drag = farthest * swing * ahead if shear else np.zeros(2)
    return drag, drag, None, False


def presses(
    programme: Programme,
    shapes: tuple[Shape, ...],
    moment: int,
    settings: Settings,
    *,
    size: tuple[int, int],
    pitch: float,
) -> tuple[tuple[Press, ...], int]:
    """The indenters at one moment, and the number of the contact they belong to (-1 between contacts).

    moment : frame of the scene. size : (width, height) of the gel, px. pitch : of its markers, px.
    """
    timing = _timing(programme, moment, settings.frames)
    if timing is None:
        return (), -1
    pitch = min(pitch, _LARGEST_STROKE)
    plan = _plan(programme, settings.seed, timing.cycle, size)
    swing = float(np.sin(np.pi * _smooth(timing.progress)))
    drag, travelled, stick, sliding = _dragged(programme, timing, plan, settings.seed, pitch, settings.shear)
    turn = np.radians(settings.twist) * plan.sign * swing
    made = [
        Press(
            shape,
            plan.x + offset_x + float(travelled[0]),
            plan.y + offset_y + float(travelled[1]),
            plan.angle + float(turn),
            timing.envelope * plan.depth * settings.depth * shape.depth,
            (float(drag[0]), float(drag[1])),
            float(turn),
            programme.dilation * pitch,
            settings.sink,
            settings.rim,
            stick,
            sliding,
        )
        for shape, (offset_x, offset_y) in zip(shapes, programme.offsets, strict=True)
    ]
    return tuple(made), timing.cycle
