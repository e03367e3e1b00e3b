"""Motion of the indenters: programmes of press, hold and release, random but reproducible.

The gel is untouched in the first tenth of a recording (one frame to two seconds) and in its last frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.sim.gel import Press
from tactflow.sim.settings import Settings
from tactflow.sim.shapes import Shape

_REST_FRACTION, _MAX_REST_FRAMES = 0.1, 120
"""Initial part of a recording without contact: its fraction, and its maximum, frames (2 s)."""
_FRAMES_PER_LAST_REST = 30
"""Length of a recording per untouched frame at its end."""
_FULL_LOAD_FRACTION = 0.75
"""Fraction of a hold after which partial slip becomes full slip."""
_MAX_CREEP_PX = 60.0
"""Amplitude of creep before it reverses, px."""
_MAX_STROKE_PITCH_PX = 110.0
"""Maximum marker pitch, px, to which displacements of the gel are proportional."""
_MAX_JUMP_PITCHES = 0.45
"""Maximum displacement of a jumping gel from its rest position, pitches: jumps of up to 0.9 pitches."""


@dataclass(frozen=True)
class Programme:
    """A series of contacts; lengths of time are in frames.

    Attributes
    ----------
    indenters : functions that make them.
    offsets : their positions, px.
    period : time between contacts.
    rise : time from touch to full depth, and back.
    hold : time at full depth.
    contacts : number spread over the recording; 0: as many as fit.
    depths : relative ones of successive contacts.
    place : mean position as a fraction of the frame.
    wander : maximum deviation from it, px.
    angles : range of the indenter's angle, degrees.
    dilation : outward displacement by a press, pitches.
    travel : distance the indenter slides during a hold, px.
    partial : whether a ball slips at the edge of the contact first.
    rolls : whether a ball turns as it travels, without slip.
    path : places on the object, px from its middle, to which the contact moves one after the other, by equal
        shares during the holds of all `contacts`. With `rolls` (and without
        `angles`) it moves over the gel alike; else the object slides round in place.
    jumps : whether the gel is dragged to a new position every third frame.
    creep : its drag, px per frame.
    tilts : rotation about the direction of motion and across it, from 0 to this and back during a hold,
        degrees.
    holds : the indenter turns on during a hold, and the gel follows by up to this angle, degrees, before it
        slips; None: it turns back, and the gel always follows.
    """

    indenters: tuple[Callable[..., Shape], ...]
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
    rolls: bool = False
    path: tuple[tuple[float, float], ...] = ()
    tilts: tuple[float, float] = (0.0, 0.0)
    holds: float | None = None


def _smooth(value: float) -> float:
    value = min(max(value, 0.0), 1.0)
    return value * value * (3.0 - 2.0 * value)


@dataclass(frozen=True, slots=True)
class _Timing:
    """Timing within a programme.

    Attributes
    ----------
    cycle : index of the contact.
    phase : frames since it began.
    rise : frames from touch to full depth.
    envelope : current relative depth, 0 to 1.
    progress : elapsed fraction of the hold, 0 to 1.
    """

    cycle: int
    phase: float
    rise: float
    envelope: float
    progress: float

    @property
    def swing(self) -> float:
        """Relative drag or turn, from 0 to 1 and back during the hold."""
        return float(np.sin(np.pi * _smooth(self.progress)))


def _timing(programme: Programme, moment: int, frames: int) -> _Timing | None:
    """The contact at a frame; None between contacts. frames : length of the recording."""
    start = min(max(1, round(_REST_FRACTION * frames)), _MAX_REST_FRAMES)
    usable = frames - start - max(1, frames // _FRAMES_PER_LAST_REST)
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


def _place(
    programme: Programme, seed: int, cycle: int, size: tuple[int, int]
) -> tuple[float, float, float, NDArray[np.float64]]:
    """Where a contact begins, px, the angle of its indenter, and the direction (2,) in which it moves."""
    rng = np.random.default_rng([seed, cycle, 0x6D6F])
    middle = np.multiply(size, programme.place)
    x = middle[0] + programme.wander[0] * rng.uniform(-1, 1)
    y = middle[1] + programme.wander[1] * rng.uniform(-1, 1)
    low, high = programme.angles
    angle = float(np.radians(rng.uniform(low, high))) if low != high else 0.0
    direction = rng.uniform(0, 2 * np.pi)
    if programme.travel:
        # Slide towards the centre, not off the gel.
        direction = np.arctan2(middle[1] - y, middle[0] - x)
    return float(x), float(y), angle, np.array([np.cos(direction), np.sin(direction)])


def _dragged(
    programme: Programme, timing: _Timing, ahead: NDArray[np.float64], settings: Settings, pitch: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float | None, bool]:
    """Displacements (2,), px, of the gel and of the indenter; `stick` and `sliding` of `Press`."""
    farthest = settings.shear * pitch
    if programme.path:
        place, _ = _rolled(programme.path, _share(programme, timing), 1.0)
        return np.zeros(2), place * programme.rolls, None, not programme.rolls and 0 < timing.progress < 1
    if programme.jumps:
        draw = np.random.default_rng([settings.seed, timing.cycle, int(timing.phase // 3), 0x6A75])
        angle, radius = draw.uniform(0, 2 * np.pi), _MAX_JUMP_PITCHES * pitch * np.sqrt(draw.uniform(0.3, 1))
        drag = radius * np.array([np.cos(angle), np.sin(angle)])
        return drag, drag, None, False
    if programme.creep:
        # Back and forth.
        distance = programme.creep * max(timing.phase - timing.rise, 0.0) % (2 * _MAX_CREEP_PX)
        drag = (_MAX_CREEP_PX - abs(distance - _MAX_CREEP_PX)) * ahead
        return drag, drag, None, False
    if programme.partial:
        load = timing.progress / _FULL_LOAD_FRACTION
        stick = max(1.0 - load, 0.0) ** (1 / 3)
        drag = farthest * (1 - stick**2) * ahead
        beyond = programme.travel * max(timing.progress - _FULL_LOAD_FRACTION, 0.0)
        return drag, drag + beyond * ahead, stick, load > 1 and timing.progress < 1
    if programme.travel:
        # Stick up to the largest drag that friction allows, then slip.
        distance = programme.travel * timing.progress
        sliding = 0 < farthest < distance and timing.progress < 1
        return min(distance, farthest) * ahead, distance * ahead, None, sliding
    drag = farthest * timing.swing * ahead
    return drag, drag, None, False


def _rolled(
    path: Sequence[tuple[float, float]], progress: float, radius: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Place (2,), px, after a share of a path, and the rotation (3, 3) of a ball that has rolled so far."""
    place, rotation = np.zeros(2), np.eye(3)
    steps = np.diff([(0.0, 0.0), *path], axis=0)
    left = progress * float(np.hypot(*steps.T).sum())
    for step in steps:
        length = float(np.hypot(*step))
        part = step * (min(left, length) / max(length, 1e-9))
        rotation = cv2.Rodrigues(np.array([-part[1], part[0], 0.0]) / radius)[0] @ rotation
        place, left = place + part, left - min(left, length)
    return place, rotation


def _share(programme: Programme, timing: _Timing) -> float:
    """Share of the path that the object has passed: each contact goes on where the last one ended."""
    return (timing.cycle + timing.progress) / max(programme.contacts, 1)


def _tilt(
    programme: Programme,
    timing: _Timing,
    angle: float,
    ahead: NDArray[np.float64],
    travelled: NDArray[np.float64],
    arm: float,
) -> tuple[float, float, float]:
    """Rotation vector of an indenter before it is turned by its angle, radians. arm : radius with which it
    rolls, px."""
    if programme.path:
        rotation = _rolled(programme.path, _share(programme, timing), arm)[1]
        x, y, z = cv2.Rodrigues(rotation)[0].ravel().tolist()
        return x, y, z
    if programme.rolls:
        about = cv2.Rodrigues(_rolled(((float(travelled[0]), float(travelled[1])),), 1.0, arm)[1])[0].ravel()
    else:
        axes = np.stack([ahead, np.array([-ahead[1], ahead[0]])])
        about = np.append(np.radians(programme.tilts) @ axes * timing.swing, 0.0)
    x, y, z = about.tolist()
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    return x * cos + y * sin, y * cos - x * sin, z


def presses(
    programme: Programme,
    shapes: tuple[Shape, ...],
    moment: int,
    settings: Settings,
    *,
    size: tuple[int, int],
    pitch: float,
) -> tuple[tuple[Press, ...], int]:
    """The indenters at a moment, and the index of their contact (-1 between contacts).

    moment : frame of the scene. size : (width, height) of the gel, px. pitch : of its markers, px.
    """
    timing = _timing(programme, moment, settings.frames)
    if timing is None:
        return (), -1
    pitch = min(pitch, _MAX_STROKE_PITCH_PX)
    x, y, angle, ahead = _place(programme, settings.seed, timing.cycle, size)
    drag, travelled, stick, sliding = _dragged(programme, timing, ahead, settings, pitch)
    turning = timing.swing if programme.holds is None else timing.progress
    turn = float(np.radians(settings.twist)) * (-1.0 if timing.cycle % 2 else 1.0) * turning
    twist = turn
    if programme.holds is not None:
        twist = float(np.clip(turn, *np.radians([-programme.holds, programme.holds])))
        sliding |= turn != twist and timing.progress < 1
    full = programme.depths[timing.cycle % len(programme.depths)] * settings.depth
    depth = timing.envelope * full
    angle += turn

    def indenter(shape: Shape, offset_x: float, offset_y: float) -> Press:
        # Rolling without slip: the mean of the surface in contact does not move.
        arm = shape.center - full * shape.depth * (1 - settings.sink) / 2
        tilt = _tilt(programme, timing, angle, ahead, travelled, arm)
        if any(tilt):
            shape = shape.rotated(np.asarray(cv2.Rodrigues(np.array(tilt))[0], np.float64))
        return Press(
            shape,
            x + offset_x + float(travelled[0]),
            y + offset_y + float(travelled[1]),
            angle,
            depth * shape.depth,
            (float(drag[0]), float(drag[1])),
            twist,
            programme.dilation * pitch,
            settings.sink,
            settings.rim,
            stick,
            sliding,
            tilt,
        )

    placed = zip(shapes, programme.offsets, strict=True)
    return tuple(indenter(shape, *offset) for shape, offset in placed), timing.cycle
