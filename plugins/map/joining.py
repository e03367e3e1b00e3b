"""Join contacts of one object that was lifted in between: patches that show the same relief are found by
normalised cross-correlation, over all turns, and registered.

References
----------
D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Processing 2012.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.stats import f

from tactflow.vision.arrays import Floats, Floats32
from tactflow.vision.pose.align import NORMAL_STDDEV_RAD
from tactflow.vision.pose.imprint import MIN_PATCH_CELLS, PATCHES_PER_SIDE, Imprint
from tactflow.vision.pose.rigid import inverse
from tactflow.vision.pose.tracker import MAX_MISFIT

from .closure import MAX_ROUNDS, MIN_OVERLAP, MISFIT_FREEDOM, registered
from .graph import spanning, twist
from .keyframes import Contact, Edge, Keyframe, shared_points

TURNS: Final = 24
"""Angles that are tried all around: a registration bridges half of these 15 degrees."""
MAX_KEYFRAMES: Final = (20, 10)
"""Keyframes that are compared, at most: of the surface so far, and of the contact that is joined."""
MAX_GUESSES: Final = 40
"""First guesses that are registered: those with the highest correlations."""
FALSE_JOIN_RATE: Final = 0.01
"""Probability of joining contacts that show nothing in common."""
MIN_RATIO: Final = float(
    f.isf(FALSE_JOIN_RATE / (TURNS * math.prod(MAX_KEYFRAMES)), MISFIT_FREEDOM, MISFIT_FREEDOM)
)
"""Misfit of a smooth patch, and of the next best motion, over that of the best motion, at least: the F test,
for the best of all turns of all pairs (Bonferroni)."""
MIN_PAIRS: Final = 2
"""Pairs of keyframes that agree on a motion, at least: a part of a relief may look like another one, as an L
looks like a part of a T, but rarely what lies beside it does, too."""
IDENTITY: Final = np.eye(4)
"""No motion."""
SAME_PLACE_MM_RADIANS: Final = np.repeat([0.5, 0.1], 3)
"""Motions that differ by less are the same."""


class _Relief(NamedTuple):
    """Spectra of a patch's relief: of its weights, its weighted heights and their weighted squares; and the
    pixel map (2, 3) with which it was turned."""

    spectra: NDArray[np.complex64]
    area: float
    turn: Floats


def joined(contacts: Sequence[Contact]) -> tuple[Contact, int]:
    """The largest contact together with those that show the same object, and the number of these contacts."""
    one, *left = sorted(contacts, key=lambda contact: -len(contact.keyframes))
    for _ in range(MAX_ROUNDS):
        alone = []
        for other in left:
            edge = bridge(one, other)
            if edge is None:
                alone.append(other)
            else:
                one = _together(one, other, edge)
        if len(alone) == len(left):
            break
        left = alone
    return one, len(contacts) - len(left)


def _together(one: Contact, other: Contact, edge: Edge) -> Contact:
    """Both contacts as one. edge : from a keyframe of one to a keyframe of the other, by their indices."""
    offset = len(one.keyframes)
    moved = [own._replace(before=own.before + offset, now=own.now + offset) for own in other.edges]
    edges = [*one.edges, *moved, edge._replace(now=edge.now + offset)]
    return Contact([*one.keyframes, *other.keyframes], edges, one.frames + other.frames)


def bridge(one: Contact, other: Contact) -> Edge | None:
    """The motion from a keyframe of a contact to one of another; None unless exactly one fits, and more than
    one pair of keyframes shows it."""
    guesses = sorted(_guesses(one, other), key=lambda guess: -guess[0])[:MAX_GUESSES]
    keyframes = [*one.keyframes, *other.keyframes]
    offset, fits = len(one.keyframes), []
    first, second = spanning(one.edges, 0), spanning(other.edges, 0)
    for _, before, now, start in guesses:
        registration = registered(keyframes, before, now + offset, start)
        if registration is None:
            continue
        misfit, edge = registration
        share = misfit / _relief_misfit(one.keyframes[before], other.keyframes[now].imprint, edge.motion)
        # The other contact's first keyframe as seen from the first one of this contact.
        whole = inverse(second[now]) @ edge.motion @ first[before]
        fits.append((share, whole, edge._replace(now=now), misfit))
    if not fits:
        return None
    share, whole, best, misfit = min(fits, key=lambda fit: fit[0])
    away = np.abs([twist(fit[1] @ inverse(whole)) for fit in fits])
    same = np.all(away < SAME_PLACE_MM_RADIANS, axis=1).tolist()
    pairs = {(fit[2].before, fit[2].now) for fit, is_same in zip(fits, same, strict=True) if is_same}
    others = [fit[0] for fit, is_same in zip(fits, same, strict=True) if not is_same]
    is_clear = misfit < MAX_MISFIT and share * MIN_RATIO < min([1.0, *others])
    return best if is_clear and len(pairs) >= MIN_PAIRS else None


def _relief_misfit(keyframe: Keyframe, shown: Imprint | None = None, motion: Floats = IDENTITY) -> float:
    """Misfit between a patch and a smooth one, in the units of a registration's.

    shown, motion : another patch and the motion to it; then only what both show counts.
    """
    template = keyframe.template
    points = template.points
    if shown is not None:
        points = points[shared_points(shown, template, motion)]
    x, y, normals, weight = points[:, 0], points[:, 1], points[:, 3:5], points[:, 5]
    patches = min(PATCHES_PER_SIDE**2, len(points) * template.every / MIN_PATCH_CELLS**2)
    square = float(weight @ (_rough(x, y, normals, weight) ** 2).sum(axis=1) / max(weight.sum(), 1e-12))
    return max(patches * square / NORMAL_STDDEV_RAD**2, 1e-12)


def _rough(x: Floats, y: Floats, values: Floats | Floats32, weight: Floats | Floats32) -> Floats:
    """(n, k): what a polynomial of second degree in x and y, (n,) each, leaves of values (n, k).

    weight : (n,), of the squares.
    """
    terms = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    root = np.sqrt(weight)[:, None]
    return np.asarray(values - terms @ np.linalg.lstsq(root * terms, root * values, rcond=None)[0])


def _guesses(one: Contact, other: Contact) -> Iterator[tuple[float, int, int, Floats]]:
    """For each pair of keyframes of both contacts and each turn, the best shift: correlation, both indices,
    motion (4, 4) from the first to the second."""
    first, second = (
        {index: contact.keyframes[index].imprint for index in _large(contact, most)}
        for contact, most in zip((one, other), MAX_KEYFRAMES, strict=True)
    )
    if not first or not second:
        return
    longest = max(max(imprint.planes.shape) for part in (first, second) for imprint in part.values())
    side = int(fft.next_fast_len(int(longest * (1 + np.sqrt(2))), real=True))
    fixed = {index: _relief(imprint, 0.0, side) for index, imprint in first.items()}
    for now, imprint in second.items():
        for angle in np.arange(TURNS) * (360 / TURNS):
            turned = _relief(imprint, float(angle), side)
            for before, shown in fixed.items():
                score, shift = _correlated(shown, turned, side)
                place = turned.turn[:, 2] + shift - shown.turn[:, 2]
                yield score, before, now, _motion(first[before], imprint, turned.turn[:, :2], place)


def _large(contact: Contact, most: int) -> list[int]:
    """Indices of some keyframes with patches of at least half the largest size, evenly along the contact; not
    of those whose relief is no larger than usual errors."""
    areas = np.array([keyframe.imprint.area for keyframe in contact.keyframes])
    large = np.flatnonzero(areas >= areas.max() / 2)
    some = large[np.unique(np.linspace(0, len(large) - 1, most).astype(int))]
    return [int(index) for index in some if _relief_misfit(contact.keyframes[index]) > MAX_MISFIT]


def _relief(imprint: Imprint, degrees: float, side: int) -> _Relief:
    """The relief of a patch, turned, in a square of some pixels."""
    weight = imprint.planes[..., 3]
    rows, columns = np.nonzero(weight)
    x, y = columns / weight.shape[1] - 0.5, rows / weight.shape[0] - 0.5
    height, known = imprint.planes[rows, columns, 2:3], weight[rows, columns]
    values = np.zeros(weight.shape, np.float32)
    values[rows, columns] = _rough(x, y, height, known)[:, 0] * known
    turn = cv2.getRotationMatrix2D(((weight.shape[1] - 1) / 2, (weight.shape[0] - 1) / 2), degrees, 1.0)
    across = int(np.hypot(*weight.shape)) + 1
    turn = turn + np.array([[0, 0, (across - length) / 2] for length in weight.shape[::-1]])
    area, value = (
        cv2.warpAffine(np.ascontiguousarray(part), turn, (across, across)) for part in (weight, values)
    )
    square = np.divide(value * value, area, out=np.zeros_like(value), where=area > 0.01)
    spectra = np.array([fft.rfft2(part, (side, side)) for part in (area, value, square)])
    return _Relief(spectra, float(area.sum()), np.asarray(turn, np.float64))


def _correlated(fixed: _Relief, moved: _Relief, side: int) -> tuple[float, Floats]:
    """Largest correlation of two patches where one shows enough of the other, and the shift, px."""
    area, value, square = fixed.spectra
    other_area, other_value, other_square = (np.conj(part) for part in moved.spectra)
    shared, product, first, second = (
        fft.irfft2(part, (side, side))
        for part in (area * other_area, value * other_value, square * other_area, area * other_square)
    )
    norm = np.sqrt(np.maximum(first * second, 1e-12))
    enough = shared > MIN_OVERLAP * moved.area
    score = np.where(enough, product / norm, -1.0)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    shift = np.array([column, row], np.float64)
    return float(score[row, column]), np.where(shift > side / 2, shift - side, shift)


def _motion(fixed: Imprint, moved: Imprint, turn: Floats, place: Floats) -> Floats:
    """(4, 4): from the frame of one patch to that of another.

    turn : (2, 2), of the other one to this one. place : (2,), of its first cell on this one, cells.
    """
    back = np.eye(4)
    back[:2, :2] = turn
    back[:2, 3] = fixed.first + fixed.cell * place - turn @ moved.first
    back[2, 3] = fixed.height - moved.height
    return inverse(back)
