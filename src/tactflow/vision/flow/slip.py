"""Slip: how the object that touches a gel moves against the gel under it."""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Floats32, Mask
from tactflow.vision.flow.displacement_field import CELL, DisplacementField, GelMotion
from tactflow.vision.flow.in_mask import OUTLINE, UNKNOWN
from tactflow.vision.flow.registration import CELL as PX
from tactflow.vision.flow.registration import Registration, Template, register, template_of
from tactflow.vision.types import Slip

WINDOW: Final = 0.1
"""Time over which the speed is measured, s, at least a frame: as late as slip may be noticed."""
SLID: Final = 0.04
"""Motion against the gel within the window that counts as slip, and drag of the gel in its direction that
friction causes then, relative to the RMS radius of the contact: gel strains by as much under a contact that
sticks."""
SPREAD: Final = np.array([5.0, 5.0, 5.0, 1.0, 0.3])
"""Standard deviation of what an object does since a keyframe beside moving with the gel: shift, turn, and
growth, cells, see `Registration`; relative change of contrast."""
OVERLAP: Final = 0.7
"""Share of the keyframe that is seen below which it is replaced."""
AGED: Final = 0.35
"""Residual from which on the keyframe is replaced: the object shows another side."""
PRESSED: Final = 0.3
"""Growth of the contact, or change of its contrast, relative, from which on the keyframe is replaced."""
ROUNDS: Final = 3
"""Of the search for the gel under a point: the field is smooth, so that each gains a digit."""
LEAST_MOVED: Final = 1e-6
"""Motion, px, that has no direction."""
EXCHANGED: Final = 0.1
"""Share of the gel in contact that has come, or has left, from which on the stick ratio is measured anew:
what presses harder or lets go moves the gel without slipping."""
CORE: Final = 0.5
"""Part of the contact, around its middle, whose motion is taken for that of the gel: slip begins at the
edge. Chosen by hand."""
LAG: Final = 0.06
"""How far gel may stay behind the motion of what sticks, relative to its RMS. Chosen on the simulator."""
UNSURE: Final = 6.0
"""Standard errors of the field's markers that gel may stay behind at least."""
ASIDE: Final = 2.0
"""How far gel may stay behind, relative to the RMS of how far it departs sideways: a press that spreads the
gel does both alike, slip only the first. Chosen on the simulator."""
_ROUNDS: Final = 4
"""Fits to the part that sticks, each to what the last one found to stick. Chosen by hand."""


class _Key(NamedTuple):
    """The frame that others are compared with: its picture and field. core : (rows, columns), share of each
    cell in the middle of the contact, which sticks longest. slid, covariance : (3,), (3, 3), slip from the
    start to it, px and radians."""

    template: Template
    field: DisplacementField
    core: Floats
    slid: Floats
    covariance: Floats


class _Moment(NamedTuple):
    """What is known at a time, s: mean motion and turn of the gel in contact, (3,), slip until then, (3,),
    its covariance, (3, 3), and what of that stems from before the keyframe; px and radians."""

    time: float
    gel: Floats
    slid: Floats
    covariance: Floats
    inherited: Floats


class SlipTracker:
    """Measures how an object moves against the gel, frame by frame.

    The picture of the contact is registered with that of a keyframe. Each point of the object then lies on
    another bit of gel than in the keyframe, or on the same one where it sticks. The rigid motion that is
    nearest to these displacements, over the gel at rest, is the slip. Keyframes are replaced as the object
    moves on or is pressed otherwise, and the slips between them add up.

    What slides drags the gel along: friction does work. What rolls over the gel, or is pressed and leaves it,
    also moves, but not in the direction of the gel's displacement.

    Examples
    --------
    >>> from tactflow.vision.flow import FieldModel
    >>> from tactflow.vision.flow.registration import cells, light_change
    >>> from tactflow.vision.types import Markers
    >>> x, y = np.meshgrid(np.arange(10.0, 200, 20), np.arange(10.0, 200, 20))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> still = Markers(origin, origin + [3.0, 0.0], np.zeros(100, np.uint8), np.full(100, 0.02))
    >>> field, tracker = FieldModel(origin, (200, 200))(still), SlipTracker()
    >>> for seq, left in enumerate((60, 60, 68)):
    ...     mask = np.zeros((200, 200), np.uint8)
    ...     mask[70:130, left : left + 60] = 255
    ...     picture = np.repeat(mask[..., None] // 5, 3, axis=2)
    ...     change = light_change(picture, cells(0 * picture), None)
    ...     slip = tracker(seq, seq / 60, change, field, mask)
    ...     print(slip.slipping, round(abs(slip.translation[0]), 1))
    False 0.0
    False 0.0
    True 8.0
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Nothing touches the gel: what comes is another contact."""
        self._key: _Key | None = None
        self._since = 0
        self._grip: tuple[Floats, Floats] | None = None
        self._last = self._before = np.zeros(5)
        self._recent: deque[_Moment] = deque()
        self._slipping = False

    def __call__(
        self, seq: int, time: float, change: Floats32, field: DisplacementField, mask: Mask
    ) -> Slip | None:
        """Slip in the next frame; None where the contact is too small or too far from markers to tell.

        seq : of the frame. time : s. change : of `light_change`. field : of this frame. mask : (H, W) uint8,
        255 in contact.
        """
        gel, template = field.motion(mask), template_of(change, mask)
        if gel is None or template is None or gel.unknown > UNKNOWN:
            self.reset()
            return None
        share, key, found = field.share(mask), self._key, None
        if key is not None and key.core.shape == share.shape:  # else markers have joined
            found = self._registered(key, change, field)
        motion = np.array([*gel.mean, gel.gradient.growth[1] if gel.gradient else 0.0])
        if key is None or found is None:
            self.reset()
            self._since, nothing = seq, np.zeros((3, 3))
            now = _Moment(time, motion, np.zeros(3), nothing, nothing)
        else:
            slid, covariance = _slid(key, found, field, gel)
            now = _Moment(time, motion, key.slid + slid, key.covariance + covariance, key.covariance)
        self._recent.append(now)
        while len(self._recent) > 2 and time - self._recent[1].time > WINDOW - 1e-6:
            self._recent.popleft()
        radius = (template if key is None else key.template).radius * PX
        slip = self._slip(radius, self._sticking(field, share), gel, field, share)
        stopped, self._slipping = self._slipping and not slip.slipping, slip.slipping
        if key is None or found is None or stopped or _aged(key, found):
            core = share * _core(field.grid.points, share)
            self._key = _Key(template, field, core, now.slid, now.covariance)
            self._grip = share, field.displacement
            self._last = self._before = np.zeros(5)
        return slip

    def _registered(self, key: _Key, change: Floats32, field: DisplacementField) -> Registration | None:
        """How the picture has moved since the keyframe: on as before, not since the last frame, or as the
        gel, whichever fits best."""
        x, y, turn = _gel_motion(key, field).tolist()
        expected = np.array([x / PX, y / PX, turn * key.template.radius, 0.0, 0.0])
        found = [
            register(key.template, change, start, expected, SPREAD)
            for start in (2 * self._last - self._before, self._last, expected)
        ]
        best = min((fit for fit in found if fit is not None), key=lambda fit: fit.residual, default=None)
        if best is not None:
            self._before, self._last = self._last, best.motion
        return best

    def _sticking(self, field: DisplacementField, share: Floats) -> float:
        """The stick ratio, on the gel that was touched first, or that a contact has rolled on to."""
        if self._grip is None:
            return 1.0
        before, displacement = self._grip
        came, left = (float(np.maximum(part, 0).sum()) for part in (share - before, before - share))
        if max(came, left) > EXCHANGED * float(share.sum()):
            self._grip = share, field.displacement
            return 1.0
        moved = field.displacement - displacement
        return stick_ratio(before, share, field.grid.points, moved, field.noise)

    def _slip(
        self, radius: float, ratio: float, gel: GelMotion, field: DisplacementField, share: Floats
    ) -> Slip:
        """The slip up to now. radius : of the contact, px."""
        then, now = self._recent[0], self._recent[-1]
        slid, stderr = now.slid.tolist(), np.sqrt(np.diag(now.covariance)).tolist()
        speed = speed_stderr = None
        probability = 0.0
        if now is not then:
            # Displacements at the RMS radius, where a turn moves the object as much as a shift.
            lever, time = np.array([1.0, 1.0, radius]), now.time - then.time
            moved = (now.slid - then.slid) * lever
            length = float(np.linalg.norm(moved))
            way = moved / max(length, LEAST_MOVED)
            covariance = now.covariance + then.covariance - 2 * then.inherited
            error = math.sqrt(float((way * lever) @ covariance @ (way * lever))) + LEAST_MOVED
            dragged = _dragged(way / lever, field, share)
            dragged_error = math.hypot(gel.stderr, *gel.outline_stderr) + LEAST_MOVED
            # Gel around the contact that counts as gel in contact stays behind what sticks.
            strained = OUTLINE * float(np.linalg.norm((now.gel - then.gel) * lever))
            slides = _normal((length - strained - SLID * radius) / error)
            probability = slides * _normal((dragged - SLID * radius) / dragged_error)
            speed, speed_stderr = length / time, error / time
        slipping = probability > 0.5
        return Slip(
            slipping,
            0.0 if slipping else ratio,
            probability,
            (slid[0], slid[1]),
            -math.degrees(slid[2]) + 0.0,
            speed,
            self._since,
            (stderr[0], stderr[1]),
            math.degrees(stderr[2]),
            speed_stderr,
        )


def _aged(key: _Key, found: Registration) -> bool:
    """Whether the keyframe is to be replaced."""
    growth, contrast = np.abs(found.motion[3:]).tolist()
    pressed = max(growth / key.template.radius, contrast) > PRESSED
    return found.seen < OVERLAP or found.residual > AGED or pressed


def _slid(key: _Key, found: Registration, field: DisplacementField, gel: GelMotion) -> tuple[Floats, Floats]:
    """Slip (3,) since the keyframe, and its covariance (3, 3), px and radians."""
    template, inside = key.template, key.core > 0
    share, rest = key.core[inside], field.grid.points[inside]
    turn = found.motion[2] / template.radius
    cos, sin = math.cos(turn), math.sin(turn)
    away = rest + key.field.displacement[inside] - template.place
    now = away @ np.array([[cos, sin], [-sin, cos]]) + template.place + found.motion[:2] * PX
    under = rest
    for _ in range(ROUNDS):
        under = now - field.at(under)
    slid, left = _rigid(rest - template.place, under - rest, share)
    to_px = np.array([PX, PX, 1 / template.radius])
    covariance = found.covariance[:3, :3] * np.outer(to_px, to_px)
    # Displacements of the gel a pitch apart are independent.
    variance = gel.stderr**2 + left / max(float(share.sum()) * CELL**2, 1.0)
    return slid, covariance + variance * np.diag([1.0, 1.0, 2 / (template.radius * PX) ** 2])


def _gel_motion(key: _Key, field: DisplacementField) -> Floats:
    """(3,): shift (x, y) at the template's centre, px, and turn, radians, since the keyframe, of the gel that
    was in contact then."""
    inside = key.core > 0
    away = (field.grid.points + key.field.displacement)[inside] - key.template.place
    return _rigid(away, (field.displacement - key.field.displacement)[inside], key.core[inside])[0]


def _core(places: Floats, share: Floats) -> Flags:
    """Which places (..., 2) with a share (...) in the contact lie around its middle."""
    away = places - share.ravel() @ places.reshape(-1, 2) / share.sum()
    distance = np.hypot(away[..., 0], away[..., 1])
    order = np.argsort(distance, axis=None)
    filled = np.cumsum(share.flat[order])
    return np.asarray(distance <= distance.flat[order[np.searchsorted(filled, CORE * filled[-1])]])


def _rigid(places: Floats, moved: Floats, share: Floats) -> tuple[Floats, float]:
    """(3,): the rigid motion nearest to displacements (N, 2) of places (N, 2): shift of the origin, px, and
    turn from +x to +y, radians; the variance that it leaves of each component, px^2."""
    share = share / share.sum()
    middle, mean = share @ places, share @ moved
    away = places - middle
    across = np.column_stack([-away[:, 1], away[:, 0]])
    turn = float(share @ (across * moved).sum(axis=1)) / max(float(share @ (away * away).sum(axis=1)), 1e-9)
    left = moved - mean - turn * across
    shift = mean + turn * np.array([middle[1], -middle[0]])
    return np.array([*shift, turn]), float(share @ (left * left).sum(axis=1)) / 2


def _dragged(motion: Floats, field: DisplacementField, share: Floats) -> float:
    """How far the gel is displaced in the direction of a motion (3,), as a mean over a contact, px."""
    x, y, turn = motion.tolist()
    moved = field.displacement
    place = field.grid.points + moved
    away = place - np.einsum("rc,rck->k", share, place) / share.sum()
    along = (x - turn * away[..., 1]) * moved[..., 0] + (y + turn * away[..., 0]) * moved[..., 1]
    return float((share * along).sum() / share.sum())


def _normal(value: float) -> float:
    """The cumulative normal distribution."""
    return math.erfc(-value / math.sqrt(2)) / 2


def stick_ratio(before: Floats, now: Floats, points: Floats, moved: Floats, noise: float) -> float:
    """Share of a contact on which the gel moves as a rigid body does.

    before, now : (rows, columns), how much of each cell is in contact. points : (rows, columns, 2), px.
    moved : (rows, columns, 2), displacement from then to now, px. noise : of a displacement, px.

    >>> points = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1)
    >>> moved = np.zeros((5, 5, 2))
    >>> moved[:, :4, 0] = 2.0
    >>> stick_ratio(np.ones((5, 5)), np.ones((5, 5)), points, moved, 0.02)
    0.8
    """
    cells = np.minimum(before, now)
    inside = cells > 0
    share, place, way = cells[inside], points[inside], moved[inside]
    if not share.any():
        return 0.0
    away = place - np.average(place, axis=0, weights=share)
    sticks = _core(place, share)
    for _ in range(_ROUNDS):
        if not sticks.any():
            return 0.0
        affine, rigid = _fitted(away, way, share * sticks)
        length = np.maximum(np.hypot(*rigid.T), 1e-9)
        left = affine - way
        behind = (left * rigid).sum(axis=1) / length
        aside = (left[:, 0] * rigid[:, 1] - left[:, 1] * rigid[:, 0]) / length
        motion, spread = (math.sqrt(np.average(part**2, weights=share)) for part in (length, aside))
        sticks = np.abs(behind) <= max(UNSURE * noise, LAG * motion, ASIDE * spread)
    return float(share[sticks].sum() / share.sum())


def _fitted(away: Floats, way: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """(n, 2): the affine motion, of points (n, 2), nearest to displacements (n, 2); its rigid part."""
    basis = np.column_stack([np.ones(len(away)), away])
    weighted = basis * weight[:, None]
    ridge = np.diag([1e-9, 1.0, 1.0])
    motion = np.linalg.solve(weighted.T @ basis + ridge, weighted.T @ way)
    turn = (motion[1, 1] - motion[2, 0]) / 2
    return basis @ motion, motion[0] + turn * away[:, ::-1] * np.array([-1.0, 1.0])
