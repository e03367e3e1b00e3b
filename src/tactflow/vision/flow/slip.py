"""Slip: how the object that touches a gel moves against the gel under it."""

from __future__ import annotations

import cmath
import math
from collections import deque
from dataclasses import replace
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np

from tactflow.vision.arrays import Flags, Floats, Floats32, Mask
from tactflow.vision.flow.displacement_field import (
    CELL_PITCHES,
    OUTLINE_STDERR_RADII,
    DisplacementField,
    Grid,
)
from tactflow.vision.flow.in_mask import MAX_UNKNOWN_SHARE
from tactflow.vision.flow.registration import CELL_PX as PX
from tactflow.vision.flow.registration import (
    MAX_RESIDUAL,
    Registration,
    Template,
    register,
    shows,
    template_of,
)
from tactflow.vision.flow.slip_event import EventTest
from tactflow.vision.geometry.similarity import Complexes, as_complex, fit_similarity
from tactflow.vision.types import Slip, SlipKind

ONSET_WINDOW_S: Final = 0.05
"""Time within which an object that slides moves beyond the threshold, s; one that creeps takes longer."""
SPEED_WINDOW_S: Final = 0.1
"""Time over which the speed is measured, s, at least one frame: the largest acceptable delay."""
SLIP_THRESHOLD_RADII: Final = 0.04
"""Threshold for the motion against the gel within the window, and for the drag of the gel in its direction by
friction, relative to the RMS radius of the contact: gel under a contact that sticks strains by as much."""
MOTION_PRIOR_STDDEV: Final = np.array([5.0, 5.0, 5.0, 1.0, 0.3])
"""Prior standard deviation of the motion of an object against the gel since a keyframe: shift, turn and
growth, cells, see `Registration`; relative change of contrast."""
MIN_OVERLAP: Final = 0.7
"""A keyframe of which a smaller share is visible is replaced."""
MAX_KEYFRAME_RESIDUAL: Final = 0.35
"""A keyframe with a larger residual is replaced: the object shows another side."""
MAX_GROWTH: Final = 0.3
"""Relative growth of a contact above which its keyframe is replaced: a larger picture shows a turn better."""
INVERSION_STEPS: Final = 3
"""Iterations of the search for the gel under a point: the field is smooth, so that each gains a digit."""
MIN_MOTION_PX: Final = 1e-6
"""Smallest motion that is divided by, px."""
MAX_EXCHANGED_SHARE: Final = 0.15
"""The stick ratio is measured anew once a larger share of the gel in contact has come or left: an object that
is pressed harder, or released, moves the gel without slipping."""
CORE_SHARE: Final = 0.5
"""Part of the contact, around its middle, whose motion counts as that of the gel: slip begins at the edge.
Chosen by hand."""
MIN_LAG_RATIO: Final = 0.06
"""How far gel that sticks may stay behind the rigid motion, relative to its RMS. Chosen on the simulator."""
MIN_LAG_STDERRS: Final = 6.0
"""Smallest such distance, in standard errors of the markers."""
MIN_LAG_TO_SIDEWAYS_RATIO: Final = 2.0
"""The same, relative to the RMS of how far the gel departs sideways: a press that spreads the gel does both
alike, slip only the first. Chosen on the simulator."""
MAX_EARLIER_KEYFRAMES: Final = 10
"""Number of replaced keyframes that are remembered: half a period of an object shaken at 1 Hz, at 25 fps."""
MAX_RETURN_RESIDUAL: Final = 0.5
"""Largest residual of a picture that is again that of an earlier keyframe: half of its contrast."""
RETURN_RADII: Final = 0.1
"""Largest distance of an object from its place in an earlier keyframe to which it has returned, relative to
the RMS radius of the contact: a few times the threshold of slip."""
MIN_SPRING_RADII: Final = 0.02
"""Smallest motion of the gel in contact, in the frame in which its picture changes abruptly, relative to the
RMS radius: half of the threshold of slip. A fast slip relaxes or strains the gel; a keyframe of a compressed
video, or a lamp that is switched, changes the picture alone."""
ROCKING_S: Final = 1.5
"""Time after the return of a picture during which the object is taken for rocking, s: some periods of
shaking."""
ROCKED_PROBABILITY: Final = 0.65
"""Largest probability of slip from one frame of a rocking object, whose picture moves in one frame of three
without a slip: seven such frames in a row are needed for a report."""
UNKNOWN_TURN: Final = math.pi / math.sqrt(3)
"""Standard deviation of a turn of which nothing is known, radians."""
_normal: Final = NormalDist().cdf
_STICK_FITS: Final = 2
"""Fits of a rigid motion, each to the gel that sticks by the one before. Chosen by hand."""


class _Key(NamedTuple):
    """The frame that others are compared with: its picture, and the gel in the middle of its contact.

    grid : of the field. cells : (rows, columns), which of its cells. rest, before : (M,) complex, their
    places at rest, and their displacements in this frame, px. share : (M,), their weights, with the sum 1.
    number : sum of their shares in contact. slid, covariance : (3,), (3, 3), slip from the start to this
    frame, px and radians. grown : natural logarithm of the growth of the contact until then. since : seq of
    the start.
    """

    template: Template
    grid: Grid
    cells: Flags
    rest: Complexes
    before: Complexes
    share: Floats
    number: float
    slid: Floats
    covariance: Floats
    grown: float
    since: int

    @property
    def lever(self) -> Floats:
        """(3,): how far a shift by 1 px, and a turn by 1 radian, move the object at the RMS radius, px."""
        return np.array([1.0, 1.0, self.template.radius * PX])


class _Tear(NamedTuple):
    """An abrupt change of the picture, which no motion of the contact explains.

    time : of the first frame after it, s. probability : that the gel was dragged then.
    """

    time: float
    probability: float


class _Moment(NamedTuple):
    """The state at a time, s.

    gel : (3,), rigid motion of the gel under the object since it was at rest. slid, covariance : (3,), (3,
    3), slip until then, px and radians, without the uncertainty by the growth of the contact. grown : see
    `_Key`. error : of the registration.
    """

    time: float
    key: _Key
    gel: Floats
    slid: Floats
    covariance: Floats
    grown: float
    error: Floats32


class SlipTracker:
    """Measures how an object moves against the gel, frame by frame.

    The picture of the contact is registered with that of a keyframe. Where the object sticks, each of its
    points still lies on the same bit of gel. The rigid motion nearest to the displacements over the gel at
    rest is the slip. Keyframes are replaced as the object moves on or is pressed differently, and the slips
    between them add up.

    An object that slides drags the gel along, by friction. One that rolls over the gel, or is pressed or
    lifted, also moves, but not in the direction of the gel's displacement.

    An object may move so far within a frame that its picture cannot be registered. That is evidence of slip
    if the object is neither just being pressed nor released, and the gel was dragged and moved at that
    moment. It is withdrawn if the picture of an earlier keyframe returns: the object rocks, or the picture
    was disturbed.
    `EventTest` adds up the evidence of frames.

    Examples
    --------
    >>> from tactflow.vision.flow import FieldModel
    >>> from tactflow.vision.flow.registration import cells, light_change
    >>> from tactflow.vision.types import Markers
    >>> x, y = np.meshgrid(np.arange(10.0, 200, 20), np.arange(10.0, 200, 20))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> still = Markers(origin, origin + [3.0, 0.0], np.zeros(100, np.uint8), np.full(100, 0.02))
    >>> field, tracker = FieldModel(origin, (200, 200))(still), SlipTracker()
    >>> for seq, left in enumerate((60, 60, 68, 76)):
    ...     mask = np.zeros((200, 200), np.uint8)
    ...     mask[70:130, left : left + 60] = 255
    ...     picture = np.repeat(mask[..., None] // 5, 3, axis=2)
    ...     change = light_change(picture, cells(0 * picture), None)
    ...     slip = tracker(seq, seq / 60, change, field, mask)
    ...     print(slip.slipping, round(abs(slip.translation[0]), 1))
    False 0.0
    False 0.0
    False 8.0
    True 16.0
    """

    def __init__(self) -> None:
        self._test = EventTest()
        self.reset()

    def reset(self) -> None:
        """Nothing touches the gel: the next contact is a new one."""
        self._key: _Key | None = None
        self._began = 0.0
        self._last = np.zeros(5)
        self._grip: tuple[Floats, Floats] | None = None
        self._recent: deque[_Moment] = deque()
        self._gel: tuple[Floats, Floats] | None = None
        self._earlier: list[_Key] = []
        self._tear: _Tear | None = None
        self._rocked = -math.inf
        self._test.reset()

    def __call__(
        self,
        seq: int,
        time: float,
        change: Floats32,
        field: DisplacementField,
        mask: Mask,
        unsteadiness: float = 3.0,
    ) -> Slip | None:
        """Slip in the next frame; None where the contact is too small or too far from markers to tell.

        seq : of the frame. time : s. change : of `light_change`. field : of this frame. mask : (H, W) uint8,
        255 in contact. unsteadiness : standard deviation of the light on the untouched gel, grey levels.
        """
        gel = field.motion(mask)
        if gel is None or gel.unknown > MAX_UNKNOWN_SHARE:
            self.reset()
            return None
        if self._key is not None and self._key.grid != field.grid:
            # Markers have been added: the grid of the field has changed.
            self.reset()
        share = field.share(mask)
        drag_stderr = math.hypot(gel.stderr, *gel.outline_stderr) + MIN_MOTION_PX
        found = None if self._key is None else self._registered(self._key, self._last, change, field)
        if (found is None or self._tear is not None) and self._returned(change, field, time):
            assert self._key is not None
            found = self._registered(self._key, self._last, change, field)
        if found is None:
            template = template_of(change, mask)
            if template is None:
                self.reset()
                return None
            shown = self._key is not None and shows(self._key.template, change)
            self._start(seq, time, template, field, share, drag_stderr, unsteadiness if shown else math.inf)
            found = Registration(np.zeros(5), np.zeros((5, 5)), 0 * template.light, 0.0, 1.0)
        key = self._key
        assert key is not None
        self._last, self._gel = found.motion, (field.displacement, share)
        now = _slid(key, found, field, time)
        self._recent.append(now)
        while len(self._recent) > 2 and time - self._recent[1].time > SPEED_WINDOW_S - 1e-6:
            self._recent.popleft()
        slip = self._slip(gel.stderr, drag_stderr)
        if slip.slipping:
            self._grip = None
        else:
            slip = replace(slip, stick_ratio=self._sticking(field, share))
        pressed = abs(now.grown - key.grown) > MAX_GROWTH
        aged = found.seen < MIN_OVERLAP or found.residual > MAX_KEYFRAME_RESIDUAL or pressed
        if aged and (template := template_of(change, mask)) is not None:
            covariance = now.covariance + _of_growth(key, now.grown - key.grown)
            self._replace(_keyframe(template, field, share, now.slid, covariance, now.grown, key.since))
        return slip

    def _replace(self, key: _Key) -> None:
        """Compare later frames with another keyframe, and remember the present one."""
        if self._key is not None:
            self._earlier = [self._key, *self._earlier][:MAX_EARLIER_KEYFRAMES]
        self._key, self._last = key, np.zeros(5)

    def _registered(
        self, key: _Key, last: Floats, change: Floats32, field: DisplacementField
    ) -> Registration | None:
        """How the picture has moved since a keyframe, starting from the last motion, or that of the gel."""
        moved = as_complex(field.displacement[key.cells]) - key.before
        x, y, turn = _rigid(key.rest + key.before - key.template.place, moved, key.share)[0].tolist()
        expected = np.array([x / PX, y / PX, turn * key.template.radius, 0.0, 0.0])
        best: Registration | None = None
        for start in (last, expected):
            found = register(key.template, change, start, expected, MOTION_PRIOR_STDDEV)
            if found is not None and (best is None or found.residual < best.residual):
                best = found
            if best is not None and best.residual < MAX_KEYFRAME_RESIDUAL:
                break
        return best

    def _returned(self, change: Floats32, field: DisplacementField, time: float) -> bool:
        """Whether the picture is again that of an earlier keyframe, on the same gel, which then is the
        present one: the object was rocked, or the picture disturbed."""
        for key in self._earlier:
            found = self._registered(key, np.zeros(5), change, field)
            if found is None or found.residual > MAX_RETURN_RESIDUAL:
                continue
            moved = (_slid(key, found, field, time).slid - key.slid) * key.lever
            if float(np.linalg.norm(moved)) < RETURN_RADII * key.lever[2]:
                self._earlier = [other for other in self._earlier if other is not key]
                self._replace(key)
                self._recent.clear()
                self._tear, self._rocked = None, time
                self._test.reset()
                return True
        return False

    def _sprung(self, field: DisplacementField, share: Floats) -> float:
        """RMS motion since the last frame of the gel that was or is in contact, px."""
        displacement, before = self._gel or (field.displacement, share)
        part = np.maximum(share, before)
        moved = np.square(field.displacement - displacement).sum(axis=-1)
        return math.sqrt(float((part * moved).sum()) / max(float(part.sum()), 1e-9))

    def _start(
        self,
        seq: int,
        time: float,
        template: Template,
        field: DisplacementField,
        share: Floats,
        drag_stderr: float,
        unsteadiness: float,
    ) -> None:
        """Begin with a keyframe that cannot be compared with those before.

        drag_stderr : standard error of the drag, px. unsteadiness : see `__call__`; infinite where markers
        hide the picture of the present keyframe.
        """
        before, last = self._key, self._recent[-1] if self._recent else None
        key = _keyframe(template, field, share, np.zeros(3), np.zeros((3, 3)), 0.0, seq)
        if before is None or last is None:
            self._began = time
        else:
            radius, contrast = template.radius * PX, before.template.contrast
            jump = key.share @ key.rest - before.share @ before.rest
            low, high = min(template.contrast, contrast), max(template.contrast, contrast)
            held = low > MAX_RESIDUAL * high or abs(jump) > radius
            sprung = self._sprung(field, share) > MIN_SPRING_RADII * radius
            if held and low > unsteadiness and sprung and time - self._began >= SPEED_WINDOW_S:
                drag = max(math.hypot(*last.gel[:2]), float(np.abs(key.share @ key.before)))
                self._tear = _Tear(time, _normal((drag - SLIP_THRESHOLD_RADII * radius) / drag_stderr))
                # The middle of the contact shows coarsely how far the object has moved.
                slid = np.array([before.slid[0] + jump.real, before.slid[1] + jump.imag, last.slid[2]])
                covariance = last.covariance + np.diag([radius**2, radius**2, UNKNOWN_TURN**2])
                key = key._replace(slid=slid, covariance=covariance, since=before.since)
        self._replace(key)
        self._recent.clear()

    def _sticking(self, field: DisplacementField, share: Floats) -> float:
        """The stick ratio of the gel that was touched first, or that the contact has moved on to."""
        before, displacement = self._grip or (0 * share, field.displacement)
        came, left = (float(np.maximum(part, 0).sum()) for part in (share - before, before - share))
        if max(came, left) > MAX_EXCHANGED_SHARE * float(share.sum()):
            self._grip = share, field.displacement
            return 1.0
        return stick_ratio(before, share, field.grid.points, field.displacement - displacement, field.noise)

    def _before(self, seconds: float) -> _Moment:
        """The last moment at least some seconds ago, or the first one."""
        now = self._recent[-1].time
        old = [moment for moment in self._recent if now - moment.time > seconds - 1e-6]
        return old[-1] if old else self._recent[0]

    def _slides(
        self, now: _Moment, gel_variance: Floats, drag_stderr: float
    ) -> tuple[float, SlipKind, float | None, float | None]:
        """Probability that the object slides, and how; its speed and the standard error, px/s; None in the
        first frame."""
        if len(self._recent) < 2:
            return 0.0, "sliding", None, None
        shares = []
        for seconds in (ONSET_WINDOW_S, SPEED_WINDOW_S):
            then = self._before(seconds)
            # Gel outside the contact that counts as inside stays behind gel that sticks.
            strain = OUTLINE_STDERR_RADII * float(np.linalg.norm((now.gel - then.gel) * now.key.lever))
            share, length, error = _slid_between(then, now, strain, gel_variance, drag_stderr)
            shares.append(share)
        time = now.time - then.time
        kind: SlipKind = "sliding" if shares[0] > 0.5 else "creeping"
        return max(shares), kind, length / time, error / time

    def _slip(self, gel_stderr: float, drag_stderr: float) -> Slip:
        """The slip up to now. gel_stderr, drag_stderr : standard errors of the mean displacement of the gel,
        by the markers alone, and by the outline as well, px."""
        now = self._recent[-1]
        key, lever = now.key, now.key.lever
        gel_variance = np.diag(gel_stderr**2 * np.array([1.0, 1.0, 2.0]) / lever**2)
        covariance = now.covariance + _of_growth(key, now.grown - key.grown) + gel_variance
        slid, stderr = now.slid.tolist(), np.sqrt(np.diag(covariance)).tolist()
        probability, kind, speed, speed_stderr = self._slides(now, gel_variance, drag_stderr)
        if self._tear is not None:
            if now.time - self._tear.time > SPEED_WINDOW_S + 1e-6:
                self._tear = None
            elif self._tear.probability > probability:
                probability, kind = self._tear.probability, "lost"
        if now.time - self._rocked < ROCKING_S:
            probability = min(probability, ROCKED_PROBABILITY)
        event = self._test(now.time, probability, kind)
        return Slip(
            slipping=event.slipping,
            stick_ratio=0.0,
            probability=event.probability,
            translation=(slid[0], slid[1]),
            rotation=-math.degrees(slid[2]) + 0.0,
            speed=speed,
            since=key.since,
            translation_stderr=(stderr[0], stderr[1]),
            rotation_stderr=math.degrees(stderr[2]),
            speed_stderr=speed_stderr,
            kind=event.kind,
            onset=event.onset,
        )


def _slid_between(
    then: _Moment, now: _Moment, strained: float, gel_variance: Floats, drag_stderr: float
) -> tuple[float, float, float]:
    """Probability that the object slid between two moments; its motion over the gel and the standard error,
    px, at the RMS radius, where a turn moves the object as much as a shift."""
    key, lever = now.key, now.key.lever
    radius = lever[2]
    common = min(key.covariance, then.key.covariance, key=np.trace)
    covariance = now.covariance + then.covariance - 2 * common
    if key is then.key:
        covariance *= 1 - _correlation(now.error, then.error)
    covariance += _of_growth(key, now.grown - then.grown) + gel_variance
    covariance *= np.outer(lever, lever)
    # Uncertain components count less: a smooth ball does not show how it turns.
    shrink = np.linalg.inv(np.eye(3) + covariance / (2 * SLIP_THRESHOLD_RADII * radius) ** 2)
    moved = shrink @ ((now.slid - then.slid) * lever)
    length = float(np.linalg.norm(moved))
    way = moved / max(length, MIN_MOTION_PX)
    error = math.sqrt(float(way @ shrink @ covariance @ way)) + MIN_MOTION_PX
    slides = _normal((length - strained - SLIP_THRESHOLD_RADII * radius) / error)
    dragged = float(way @ (now.gel * lever)) - SLIP_THRESHOLD_RADII * radius
    return slides * _normal(dragged / drag_stderr), length, error


def _keyframe(
    template: Template,
    field: DisplacementField,
    share: Floats,
    slid: Floats,
    covariance: Floats,
    grown: float,
    since: int,
) -> _Key:
    """The frame that others are compared with. share : (rows, columns), of each cell in contact."""
    inside = share > 0
    inside[inside] = _core(field.grid.points[inside], share[inside])
    rest, before = as_complex(field.grid.points[inside]), as_complex(field.displacement[inside])
    count = float(share[inside].sum())
    weights = share[inside] / count
    return _Key(template, field.grid, inside, rest, before, weights, count, slid, covariance, grown, since)


def _slid(key: _Key, found: Registration, field: DisplacementField, time: float) -> _Moment:
    """The slip up to a time."""
    place, radius = key.template.place, key.template.radius
    x, y, turn = found.motion[:3].tolist()
    now = (key.rest + key.before - place) * cmath.exp(1j * turn / radius) + complex(x, y) * PX
    under = key.rest - place
    for _ in range(INVERSION_STEPS):
        moved = as_complex(field.at((under + place).view(np.float64).reshape(-1, 2)))
        under = now - moved
    slid, left = _rigid(key.rest - place, under + place - key.rest, key.share)
    to_px = np.array([PX, PX, 1 / radius])
    # Displacements of the gel a pitch apart are independent.
    variance = left / max(key.number * CELL_PITCHES**2, 1.0)
    covariance = key.covariance + found.covariance[:3, :3] * np.outer(to_px, to_px)
    covariance += variance * np.diag([1.0, 1.0, 2 / (radius * PX) ** 2])
    gel = _rigid(now - key.share @ now, moved, key.share)[0]
    grown = float(found.motion[3]) / radius
    return _Moment(time, key, gel, key.slid + slid, covariance, key.grown + grown, found.error)


def _of_growth(key: _Key, grown: float) -> Floats:
    """(3, 3), px and radians: uncertainty of the shift by a growth of the contact around an unknown point."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = (grown * PX) ** 2 * key.template.moments
    return covariance


def _rigid(places: Complexes, moved: Complexes, share: Floats) -> tuple[Floats, float]:
    """(3,): the rigid motion nearest to displacements of places: shift of the origin, px, and turn from +x to
    +y, radians; the residual variance of each component, px^2. share : weights, with the sum 1."""
    fit = fit_similarity(places, moved, share)
    turn = 1j * fit.slope.imag
    shift = fit.mean - turn * fit.middle
    left = np.abs(moved - fit.mean - turn * fit.away)
    return np.array([shift.real, shift.imag, turn.imag]), float(share @ (left * left)) / 2


def _core(places: Floats, share: Floats) -> Flags:
    """Which places (n, 2), with shares (n,) in the contact, lie around its middle."""
    distance = np.hypot(*(places - share @ places / share.sum()).T)
    order = np.argsort(distance)
    filled = np.cumsum(share[order])
    return np.asarray(distance <= distance[order[np.searchsorted(filled, CORE_SHARE * filled[-1])]])


def _correlation(first: Floats32, second: Floats32) -> float:
    """Correlation of the residuals of two registrations with one template, 0 to 1."""
    power = math.sqrt(float(np.vdot(first, first)) * float(np.vdot(second, second)))
    return max(float(np.vdot(first, second)), 0.0) / max(power, 1e-9)


def stick_ratio(before: Floats, now: Floats, points: Floats, moved: Floats, noise: float) -> float:
    """Share of a contact on which the gel moves as a rigid body does.

    before, now : (rows, columns), how much of each cell is in contact. points : (rows, columns, 2), px.
    moved : (rows, columns, 2), displacement from then to now, px. noise : of a displacement, px.

    >>> points = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0)), axis=-1)
    >>> moved = np.zeros((5, 5, 2))
    >>> moved[:, :4, 0] = 2.0
    >>> round(stick_ratio(np.ones((5, 5)), np.ones((5, 5)), points, moved, 0.02), 3)
    0.8
    """
    cells = np.minimum(before, now)
    inside = cells > 0
    if not inside.any():
        return 0.0
    share, places, way = cells[inside] / cells.sum(), as_complex(points[inside]), as_complex(moved[inside])
    sticks = _core(points[inside], share)
    for _ in range(_STICK_FITS):
        weight = share * sticks
        if not sticks.any():
            return 0.0
        fit = fit_similarity(places, way, weight / weight.sum())
        rigid = fit.mean + 1j * fit.slope.imag * fit.away
        length = np.abs(rigid)
        # Along the motion, and aside of it.
        behind = (fit.mean + fit.slope * fit.away - way) * rigid.conj() / np.maximum(length, 1e-9)
        motion, spread = (math.sqrt(share @ (part * part)) for part in (length, behind.imag))
        sticks = np.abs(behind.real) <= max(
            MIN_LAG_STDERRS * noise, MIN_LAG_RATIO * motion, MIN_LAG_TO_SIDEWAYS_RATIO * spread
        )
    return float(share[sticks].sum() / share.sum())
