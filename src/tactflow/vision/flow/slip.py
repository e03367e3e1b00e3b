"""Slip of what touches the gel: all of it, or at the edge of the contact first."""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.vision.arrays import Floats
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.flow.in_mask import UNKNOWN
from tactflow.vision.types import Slip

EXCHANGED: Final = 0.1
"""Share of the gel in contact that was exchanged for other gel, from which on a contact slips. In simulated
presses, twists and drags that stick it is 0.06 at most; a ball with a contact of radius r exchanges as much
when it has slid by 0.16 r."""
GOES_ON: Final = 0.03
"""Share exchanged within `RECENT` frames while which a slip goes on. Chosen by hand."""
RECENT: Final = 3
"""Frames over which it is told whether a slip goes on: 0.05 s at 60 frames a second. Chosen by hand."""
GROWN: Final = 0.08
"""Change of the contact's area, relative, after which slip is measured from this frame on: what presses
harder or lets go moves the gel without slipping. Chosen by hand."""
DRAGGED: Final = 3.0
"""Standard errors of the mean flow by which the gel must lie in the direction of the motion: friction drags
it along. What rolls over the gel does not: it presses one bit of gel after the other, and sticks."""
SHIFTED: Final = 0.5
"""Part of the exchange that the shift of the contact's middle must explain: an outline that flickers comes
and goes in other ways. Chosen on a simulated box of which the light shows a fifth, another one each frame."""
CORE: Final = 0.5
"""Part of the contact, around its middle, from which the motion of what sticks is first taken. Chosen by
hand: slip begins at the edge."""
LAG: Final = 0.06
"""How far gel may stay behind the motion of what sticks, relative to its RMS. Chosen on the simulator."""
UNSURE: Final = 6.0
"""Standard errors of the field's markers that gel may stay behind at least."""
ASIDE: Final = 2.0
"""How far gel may stay behind, relative to the RMS of how far it departs sideways: a press that spreads the
gel does both alike, slip only the first. Chosen on the simulator."""
_ROUNDS: Final = 4
"""Fits to the part that sticks, each to what the last one found to stick. Chosen by hand."""


class _Touched(NamedTuple):
    """The gel in contact in one frame: (rows, columns) share of each cell; (rows, columns, 2) moved, px."""

    share: Floats
    moved: Floats
    area: float


class SlipTest:
    """Tells whether a contact slips, frame by frame.

    Gross slip shows in which gel is touched: what slides leaves gel behind and takes new gel, while a press
    only takes new gel, and letting go only leaves some. Incipient slip shows in how the gel moves under the
    contact: where it sticks it moves as the rigid object does, and where it slips it stays behind. Both are
    measured from a frame in which the contact was as large as now.

    References
    ----------
    S. Dong, D. Ma, E. Donlon, A. Rodriguez, "Maintaining grasps within slipping bounds by monitoring
    incipient slip", ICRA 2019, for the departure from a rigid motion.

    Examples
    --------
    >>> from tactflow.vision.flow.displacement_field import FieldModel
    >>> from tactflow.vision.types import Markers
    >>> x, y = np.meshgrid(np.arange(10.0, 200, 20), np.arange(10.0, 200, 20))
    >>> origin = np.column_stack([x.ravel(), y.ravel()])
    >>> still = Markers(origin, origin + [3.0, 0.0], np.zeros(100, np.uint8), np.full(100, 0.02))
    >>> field, test = FieldModel(origin, (200, 200))(still), SlipTest()
    >>> for left in (60, 60, 68):
    ...     mask = np.zeros((200, 200), np.uint8)
    ...     mask[70:130, left : left + 60] = 255
    ...     print(test(field, mask).slipping)
    False
    False
    True
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Nothing touches the gel: what comes is another contact."""
        self._start: _Touched | None = None
        self._recent: deque[_Touched] = deque(maxlen=RECENT)
        self._slipping = False

    def __call__(self, field: DisplacementField, mask: NDArray[np.uint8]) -> Slip | None:
        """Judge the next frame; None where the contact is too small or too far from markers to tell.

        field : of this frame. mask : (H, W) uint8, 255 in contact, else 0.
        Raises ValueError if mask is not (H, W) uint8.
        """
        now = _touched(field, mask)
        if now is None:
            self.reset()
            return None
        if self._start is not None and self._start.share.shape != now.share.shape:
            # Markers that joined have changed the grid of the field.
            self.reset()
        start = self._start
        if start is None or abs(now.area - start.area) > GROWN * start.area:
            start = self._start = now
        slides = self._slipping and _exchanged(self._recent[0], now) > GOES_ON
        travel = _Travel.SLID if slides else _travelled(start, now, field, mask)
        self._slipping = travel is _Travel.SLID
        self._recent.append(now)
        if travel is not _Travel.NONE:
            # Measured anew: from where what slides comes to rest, and on the gel that what rolls has reached.
            self._start = now
            return Slip(self._slipping, 0.0 if self._slipping else 1.0)
        return Slip(
            False,
            stick_ratio(start.share, now.share, field.grid.points, now.moved - start.moved, field.noise),
        )


def _touched(field: DisplacementField, mask: NDArray[np.uint8]) -> _Touched | None:
    share = field.share(mask)
    area = float(share.sum())
    return _Touched(share, field.displacement, area) if area > 0 else None


def _exchanged(before: _Touched, now: _Touched) -> float:
    """Share of the gel in contact that came and went: the lesser of both."""
    gained = np.maximum(now.share - before.share, 0).sum()
    return float(min(gained, gained - now.area + before.area) / min(now.area, before.area))


class _Travel(Enum):
    """How a contact has moved over the gel."""

    NONE = 0
    SLID = 1
    ROLLED = 2


def _travelled(before: _Touched, now: _Touched, field: DisplacementField, mask: NDArray[np.uint8]) -> _Travel:
    """Whether the contact as a whole has moved over the gel, and whether it drags the gel along."""
    exchanged = _exchanged(before, now)
    motion = field.motion(mask) if exchanged > EXCHANGED else None
    if motion is None or motion.unknown > UNKNOWN:
        return _Travel.NONE
    shares = now.share / now.area - before.share / before.area
    x, y = np.einsum("rc,rck->k", shares, field.grid.points).tolist()
    spacing = field.grid.spacing
    shift = np.array([[1, 0, x / spacing], [0, 1, y / spacing]])
    rows, columns = before.share.shape
    share = np.asarray(cv2.warpAffine(before.share, shift, (columns, rows)), np.float64)
    if _exchanged(before._replace(share=share), now) >= SHIFTED * exchanged:
        return _Travel.NONE
    along = (x * motion.mean[0] + y * motion.mean[1]) / max(math.hypot(x, y), 1e-9)
    stderr = math.hypot(motion.stderr, max(motion.outline_stderr))
    return _Travel.SLID if along > DRAGGED * stderr else _Travel.ROLLED


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
    distance = np.hypot(away[:, 0], away[:, 1])
    order = np.argsort(distance)
    filled = np.cumsum(share[order])
    sticks = distance <= distance[order[np.searchsorted(filled, CORE * filled[-1])]]
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
