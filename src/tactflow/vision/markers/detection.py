"""Find the printed marks of a gel: sub-pixel centres, their sizes, their polarity and their neighbours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import cdist

from tactflow.vision.arrays import Floats, Floats32, check_mask
from tactflow.vision.compiled import kernel
from tactflow.vision.markers.lattice import MAX_LINK_PITCHES, Lattice, nearest, neighbour_graph, pitch_of
from tactflow.vision.markers.selection import (
    Candidate,
    Polarity,
    at_own_scale,
    candidates,
    evidence,
    marks_of,
    probability,
)
from tactflow.vision.markers.spots import SAME_SIZE_RATIO, Spots, find_spots, sigmas

PolarityOption = Literal["auto", "dark", "bright"]

MIN_SCORE: Final = 2.5
"""Minimum score of a candidate to be accepted as marks (see `selection.candidates`). Real gels with marks
score 4 and more; dust, reflections and noise on gels without marks at most 0.4, compression artefacts along
edges up to 3, in 36 of 38 such pictures of wedge_grasp up to 2.4 (measured). Marks 3.5 px apart score as
little."""

MAX_LEVEL_BETWEEN: Final = 0.01
"""Maximum level half-way between two neighbouring marks, on a scale from the gel's level (0) to that of the
marks (1), in the better of two directions: dashes may touch in the other one. The gel is sampled on the
diagonal, 0.7 of the way to the middle of a cell, where another lattice may have its marks. Two crossing
waves, as in a weave, have 0.37 if they are alike, 0.16 if one is twice as strong. Marks of 18 sensors, and of
164 simulated ones, have at most 0.00 (measured)."""

MAX_POLARITY_SCORE_RATIO: Final = 0.8
"""Ratio of the scores of the best candidates of the two polarities above which there are no marks: a texture
looks the same with dark and bright swapped, marks on a gel do not. Marks of 18 sensors have at most 0.67,
dashes that touch 0.78; three of twelve simulated cloths that no other test rejects have 0.86 and more
(measured), as have marks that cover 0.4 of the gel."""

MAX_RADIUS_PER_SPACING: Final = 0.32
"""Maximum radius of a mark over the distance of its nearest neighbour, so that its surroundings hold no other
mark. With 0.37, 0.2 % of the marks of seven recordings are lost (measured)."""

CENTROID_WINDOW_RADII: Final = 1.6
"""Radius of the window of a centroid, in radii of the mark. Chosen by hand: it includes the mark's border."""

BACKGROUND_RING_RADII: Final = (1.4, 1.9)
"""Inner and outer radius of the ring for the background of a mark, in radii of the mark; the outer one is 1.5
px wider. Chosen by hand."""

MIN_DARKNESS: Final = 1e-3
"""Grey levels, summed over a window, below which it has no centroid: rounding."""

LONE_PITCH_RADII: Final = 8.0
"""Pitch assumed for a single mark, in radii. Chosen by hand."""

_NO_MARKERS: Final = (
    "0 markers found: is the sensor marker-less? then use the pipeline markerless, or one that is made for "
    "your sensor without dots (tactflow pipelines)"
)
_FEW_MARKERS: Final = " (if it has only a few marks, give their radius in pixels)"


class NoMarkersError(ValueError):
    """The image shows no trackable marks.

    Parameters
    ----------
    best : the best candidate, or None.
    """

    def __init__(self, message: str, best: Candidate | None = None) -> None:
        super().__init__(message)
        self.best = best


@dataclass(frozen=True, slots=True)
class Detection:
    """The marks of an image.

    Attributes
    ----------
    centers : (N, 2) float64, px.
    dot_radius : of a disc with the response of most marks, px.
    polarity : whether the marks are darker or brighter than the gel.
    pitch : median distance of a mark to its nearest neighbour, px; with one mark, eight radii.
    edges : (E, 2) int64, pairs of neighbouring marks, each pair once, smaller index first.
    radii : (N,) float64, of each mark, px; None if all have the same size.
    chosen : the candidate that the marks were grown from.
    rival : the next best one elsewhere, or None.
    evidence : (N, 3) float64, features behind the probability of each mark (see `selection.evidence`).
    """

    centers: Floats
    dot_radius: float
    polarity: Literal["dark", "bright"]
    pitch: float
    edges: NDArray[np.int64]
    radii: Floats | None = None
    chosen: Candidate | None = None
    rival: Candidate | None = None
    evidence: Floats | None = None

    @property
    def probability(self) -> Floats | None:
        """(N,) float64, probability that each mark is one, 0 to 1; NaN for a single mark. None without
        evidence."""
        return None if self.evidence is None else probability(self.evidence)


def require_image(image: NDArray[np.uint8]) -> None:
    """Raise ValueError unless the image is a non-empty (H, W, 3) or (H, W) uint8."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(
            f"required image to be (H, W, 3) or (H, W) uint8, got shape {image.shape}, dtype {image.dtype}"
        )
    if min(image.shape[:2]) < 1:
        raise ValueError(f"required a non-empty image, got shape {image.shape}")


def to_gray(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR, or (H, W) uint8, to (H, W) uint8 luma; raises ValueError on anything else.

    >>> to_gray(np.full((2, 2, 3), 7, np.uint8)).tolist()
    [[7, 7], [7, 7]]
    """
    require_image(image)
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2GRAY), np.uint8)


def detect_markers(
    image: NDArray[np.uint8],
    *,
    dot_radius: float | None = None,
    polarity: PolarityOption = "auto",
    valid: NDArray[np.uint8] | None = None,
    least_probability: float = 0.5,
) -> Detection:
    """Detect the marks of a gel: of one size or many, of any shape, in one lattice or several.

    Differences of Gaussians over a range of scales give spots of every size. Those of one scale with the most
    contrast in the best lattice are marks, at the scale at which they respond most; a random texture forms no
    lattice. Spots of other scales are added where the lattice predicts a mark. Weak spots, spots between
    others and spots cut by the border are rejected.

    Parameters
    ----------
    image : (H, W, 3) uint8 BGR or (H, W) uint8, grey levels.
    dot_radius : of a (whole) mark, px, 1 to a quarter of the shorter side; None estimates it, but requires at
        least four marks in a regular arrangement, so that dust is not mistaken for marks.
    polarity : "dark" or "bright" against the gel; "auto" takes the better lattice.
    valid : (H, W) uint8, non-zero where there is gel; marks are only searched where most of the surroundings
        are gel. None: everywhere.
    least_probability : minimum probability of a mark, 0 to 1; only if `dot_radius` is None.

    Returns
    -------
    Detection : centres ordered by rows, top to bottom, left to right. The search runs in float32, the
        centres are refined in float64; a search in float64 would give the same to 1e-3 px.

    Raises
    ------
    NoMarkersError : nothing looks like marks.
    ValueError : the image or a parameter is invalid.

    References
    ----------
    Lindeberg, "Feature detection with automatic scale selection", IJCV 30 (1998); Lowe, "Distinctive image
    features from scale-invariant keypoints", IJCV 60 (2004), for the difference of Gaussians.

    Examples
    --------
    >>> from tactflow.sim import open_scene
    >>> found = detect_markers(open_scene("press?frames=2").frame(0))
    >>> found.polarity, found.centers.shape[1]
    ('dark', 2)
    """
    gray = to_gray(image).astype(np.float32)
    _require_options(dot_radius, polarity, valid, gray.shape)
    shortest = min(gray.shape)
    signs: tuple[Polarity, ...] = ("dark", "bright") if polarity == "auto" else (polarity,)
    scales = {
        sign: {s: find_spots(gray, s, sign, valid) for s in sigmas(dot_radius, shortest)} for sign in signs
    }
    found = candidates(scales) if shortest >= 8 else []
    if not found:
        raise NoMarkersError(_NO_MARKERS)
    if dot_radius is not None:
        return _detection(gray, found[0], found[0].spots, found[1:])
    return _in_lattice(gray, found, scales[found[0].polarity], least_probability)


def _in_lattice(
    gray: NDArray[np.float32], found: list[Candidate], by_scale: Mapping[float, Spots], least: float
) -> Detection:
    """The marks of the best candidate; raises NoMarkersError if they look like something else.

    by_scale : the spots of its polarity for each scale, px. least : minimum probability of a mark.
    """
    _require_lattice(found)
    best = at_own_scale(found[0], found)
    _require_gel_between(gray, best, best.lattice)
    marks = marks_of(gray, best, by_scale)
    _require_gel_between(gray, best, Lattice(marks.points))
    # A single mark has no probability.
    marks = marks.at(~(probability(evidence(gray, marks)) < least))
    if not len(marks.points):
        raise NoMarkersError(_NO_MARKERS + _FEW_MARKERS, best)
    detection = _detection(gray, best, marks, [other for other in found if other is not best])
    rival = detection.rival
    if (
        rival is not None
        and rival.polarity != best.polarity
        and rival.score > MAX_POLARITY_SCORE_RATIO * found[0].score
    ):
        raise NoMarkersError(
            f"{_NO_MARKERS} ({best} are as regular as {rival}, as in a texture; if either are "
            "marks, give their polarity)",
            best,
        )
    return detection


def _levels(gray: NDArray[np.float32], points: Floats) -> NDArray[np.float32]:
    """(N,) grey level at points (N, 2), px, interpolated."""
    return np.asarray(map_coordinates(gray, points.T[::-1], order=1, mode="nearest"), np.float32)


def _require_lattice(found: list[Candidate]) -> None:
    """Raise NoMarkersError if the best candidate has too few or too faint spots, or forms no lattice."""
    if found[0].score >= MIN_SCORE:
        return
    best = max(found, key=lambda other: float(other.spots.strength.sum()))
    raise NoMarkersError(
        f"{_NO_MARKERS} ({len(best.spots.points)} {best.polarity} spots of radius "
        f"{best.radius:.1f} px form no lattice: {100 * best.lattice.closed_share:.0f} % of their "
        "parallelograms close, of a grid's 80 %; if they are marks, and no dust or random texture, give "
        "their radius in pixels)",
        best,
    )


def _require_gel_between(gray: NDArray[np.float32], best: Candidate, lattice: Lattice) -> None:
    """Raise NoMarkersError if the marks run into each other, without even gel between them, as in a weave."""
    points, radius, around = lattice.points, best.radius, lattice.corners
    if not len(around.points):
        return
    smooth = np.asarray(cv2.GaussianBlur(gray, (0, 0), 0.2 * radius), np.float32)
    mark, first, last = points[around.middle], points[around.first], points[around.last]
    marks, gel, one, other = (
        _levels(smooth if best.polarity == "dark" else -smooth, places)
        for places in (mark, 0.3 * mark + 0.35 * (first + last), (mark + first) / 2, (mark + last) / 2)
    )
    if np.median(gel - np.maximum(one, other)) > MAX_LEVEL_BETWEEN * np.median(gel - marks):
        raise NoMarkersError(
            f"{_NO_MARKERS} ({len(points)} {best.polarity} spots of radius {radius:.1f} px run into each "
            "other, like the threads of a cloth; if they are marks, give their radius in pixels)",
            best,
        )


def _detection(
    gray: NDArray[np.float32], best: Candidate, marks: Spots, others: list[Candidate]
) -> Detection:
    """The marks in reading order, with the best rival candidate."""
    radius = best.radius
    ratio = np.maximum(marks.radius / radius, radius / marks.radius)
    radii = np.where(ratio < SAME_SIZE_RATIO, radius, marks.radius)
    if len(radii) > 1:
        radii = np.minimum(radii, MAX_RADIUS_PER_SPACING * nearest(marks.points, 1)[0][:, 0])
    centers = _centroids(gray if best.polarity == "dark" else 255 - gray, marks.points, radii)
    order = _reading_order(centers, radius)
    centers, radii, marks = centers[order], radii[order], marks.at(order)
    pitch = pitch_of(centers) if len(centers) > 1 else LONE_PITCH_RADII * radius
    edges = neighbour_graph(centers, MAX_LINK_PITCHES * pitch)
    rival = next((other for other in others if not _same(other, centers, radii)), None)
    sizes = radii if (radii != radius).any() else None
    return Detection(centers, radius, best.polarity, pitch, edges, sizes, best, rival, evidence(gray, marks))


def _centroids(gray: Floats32, centers: Floats, radii: Floats) -> Floats:
    """Centroids (N, 2) of dark marks in windows that follow them, px.

    The background is a plane fitted to a ring around the mark, so a gradient of the light does not bias them.

    gray : (H, W) float32, grey levels; marks are dark. centers : (N, 2) float64, starting points, px, within
    about a radius; they stay where nothing is darker than the background. radii : (N,) float64, of the marks,
    px.
    """
    result = np.array(centers, np.float64)
    inner, outer = BACKGROUND_RING_RADII[0] * radii, BACKGROUND_RING_RADII[1] * radii + 1.5
    window = CENTROID_WINDOW_RADII * radii + 0.5
    move_to_centroids(gray, radii, inner, outer, window, MIN_DARKNESS, result)
    return result


@kernel
def move_to_centroids(
    gray: Floats32,
    radii: Floats,
    inner: Floats,
    outer: Floats,
    window: Floats,
    least: float,
    centers: Floats,
) -> None:
    """Move points four times to the centroid of what is darker than the background around them.

    gray : (H, W) float32. radii : (N,), px, the largest step along an axis. inner, outer : (N,), px, of the
    ring of the background. window : (N,), px, radius of what is counted, less than `outer`. least : sum of
    the darkness that has a centroid. centers : (N, 2),
    px, changed in place.
    """
    reach = int(np.ceil(outer.max(initial=0)))
    axis = np.arange(-reach, reach + 1)
    grid_x, grid_y = (part.ravel() for part in np.meshgrid(axis, axis))
    padded = cv2.copyMakeBorder(gray, reach, reach, reach, reach, cv2.BORDER_REPLICATE).astype(np.float64)
    limits = np.array(gray.shape[::-1]) - 1
    # Each step is a fraction of the one before.
    for _ in range(4):
        corner = np.clip(np.rint(centers).astype(np.int64), 0, limits)
        patches = padded[corner[:, 1:] + grid_y + reach, corner[:, :1] + grid_x + reach]
        x = grid_x + corner[:, :1] - centers[:, :1]
        y = grid_y + corner[:, 1:] - centers[:, 1:]
        distance = np.hypot(x, y)
        ring = np.clip(distance - inner[:, None], 0, 1) * np.clip(outer[:, None] - distance, 0, 1)
        basis = np.stack([np.ones_like(x), x, y], axis=1)
        weighted = basis * ring[:, None]
        normal = weighted @ basis.transpose(0, 2, 1)
        plane = np.linalg.solve(normal, weighted @ patches[:, :, None])
        darkness = np.maximum((basis.transpose(0, 2, 1) @ plane)[:, :, 0] - patches, 0)
        darkness *= np.clip(window[:, None] - distance, 0, 1)
        total = darkness.sum(axis=1)
        good = total > least
        move = np.zeros_like(centers)
        move[good, 0] = (darkness * x).sum(axis=1)[good] / total[good]
        move[good, 1] = (darkness * y).sum(axis=1)[good] / total[good]
        centers += np.clip(move, -radii[:, None], radii[:, None])


def _same(other: Candidate, centers: Floats, radii: Floats) -> bool:
    """Whether most spots of another candidate are the same marks at another scale, or their highlights."""
    return bool(np.any(cdist(other.centers, centers) < radii, axis=1).mean() > 0.5)


def _require_options(
    dot_radius: float | None, polarity: str, valid: NDArray[np.uint8] | None, shape: tuple[int, ...]
) -> None:
    """Raise ValueError for invalid options of `detect_markers`."""
    largest = max(1.0, min(shape) / 4)
    if dot_radius is not None and not 1.0 <= dot_radius <= largest:
        raise ValueError(f"required dot_radius 1 to {largest:g} px, got {dot_radius:g}")
    if polarity not in ("auto", "dark", "bright"):
        raise ValueError(f"required polarity to be 'auto', 'dark' or 'bright', got {polarity!r}")
    if valid is not None:
        check_mask(valid, shape, "valid")


def _reading_order(centers: Floats, radius: float) -> NDArray[np.int64]:
    """Order by rows: a new row begins where the next centre lies a radius lower than the one before."""
    by_height = np.argsort(centers[:, 1], kind="stable")
    rows = np.concatenate([[0], np.cumsum(np.diff(centers[by_height, 1]) > radius)])
    return by_height[np.lexsort((centers[by_height, 0], rows))]
