"""From the raw frame to the processed one, with the exact mapping between their coordinates.

The steps, in this order; each works in the pixels of the result of the one before it:

1. undistort: take out the lens (size unchanged, same camera matrix);
2. homography: four points go to four points; the result has the given size;
3. crop: keep a rectangle;
4. rotate: clockwise by 0, 90, 180 or 270 degrees;
5. downsample: by averaging blocks ("area") or by Gaussian pyramid ("pyramid").

All coordinates have the centre of the top-left pixel at (0, 0). A k-fold block average therefore maps x to
(x - (k - 1) / 2) / k, while `cv2.pyrDown`, whose output pixel i is centred on input pixel 2 i, maps x to
x / 2: the two pictures look alike and lie half a raw pixel apart. `PixelMapping` keeps track of that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactflow.vision.geometry.downsample import halved

Method = Literal["area", "pyramid"]
FloatArray = NDArray[np.float64]

_ROTATIONS: Final = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}
_DISTORTION_LENGTHS: Final = (4, 5, 8, 12, 14)
# 16-bit signed map entries address at most this many pixels along an axis.
_LARGEST_FIXED_POINT: Final = 32000


@dataclass(frozen=True, eq=False, slots=True)
class Lens:
    """A camera's intrinsic calibration, as `cv2.calibrateCamera` or `cv2.fisheye.calibrate` give it.

    camera_matrix : (3, 3) float64, px. distortion : (4 | 5 | 8 | 12 | 14,) float64 for the polynomial model,
    (4,) for the fisheye model. fisheye : which of the two models.
    """

    camera_matrix: FloatArray
    distortion: FloatArray
    fisheye: bool = False

    def distort(self, points: FloatArray) -> FloatArray:
        """Where the lens puts points of the undistorted frame: (N, 2) float64 px -> (N, 2) float64 px."""
        if len(points) == 0:
            return points.copy()
        matrix = self.camera_matrix
        normalised = np.empty((len(points), 2))
        normalised[:, 1] = (points[:, 1] - matrix[1, 2]) / matrix[1, 1]
        normalised[:, 0] = (points[:, 0] - matrix[0, 2] - matrix[0, 1] * normalised[:, 1]) / matrix[0, 0]
        if self.fisheye:
            return _fisheye(normalised, self.distortion) @ matrix[:2, :2].T + matrix[:2, 2]
        rays = np.column_stack([normalised, np.ones(len(points))])
        nothing = np.zeros(3)
        # projectPoints ignores a camera matrix's skew: it gets the identity, and the matrix is applied here.
        projected, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), nothing, nothing, np.eye(3), self.distortion)
        bent = np.asarray(projected, dtype=np.float64).reshape(-1, 2)
        return bent @ matrix[:2, :2].T + matrix[:2, 2]

    def undistort(self, points: FloatArray) -> FloatArray:
        """Inverse of `distort`, by Newton's method with a numerical Jacobian.

        `cv2.undistortPoints` stops after five fixed-point steps, which leaves tenths of a pixel for strong
        distortion. Points that no undistorted point maps to end at the nearest the iteration came.
        """
        guess = points.copy()
        if len(points) == 0:
            return guess
        step = 1e-3
        right_step, down_step = np.diag([step, step])
        error = self.distort(guess) - points
        size = np.hypot(error[:, 0], error[:, 1])
        damping = np.ones(len(points))
        for _ in range(60):
            if float(size.max()) < 1e-10:
                break
            right = (self.distort(guess + right_step) - self.distort(guess - right_step)) / (2 * step)
            down = (self.distort(guess + down_step) - self.distort(guess - down_step)) / (2 * step)
            determinant = right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0]
            determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            move = np.column_stack(
                [
                    (down[:, 1] * error[:, 0] - down[:, 0] * error[:, 1]) / determinant,
                    (right[:, 0] * error[:, 1] - right[:, 1] * error[:, 0]) / determinant,
                ]
            )
            trial = guess - damping[:, None] * move
            trial_error = self.distort(trial) - points
            trial_size = np.hypot(trial_error[:, 0], trial_error[:, 1])
            better = trial_size < size
            guess[better], error[better], size[better] = (
                trial[better],
                trial_error[better],
                trial_size[better],
            )
            damping = np.where(better, np.minimum(1.0, 2 * damping), damping / 2)
        return guess


def _fisheye(normalised: FloatArray, distortion: FloatArray) -> FloatArray:
    """Kannala and Brandt's (2006) equidistant model with four coefficients, on normalised points."""
    radius = np.hypot(normalised[:, 0], normalised[:, 1])
    theta = np.arctan(radius)
    squared = theta * theta
    k1, k2, k3, k4 = distortion
    bent = theta * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))
    scale: FloatArray = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-12)
    return normalised * scale[:, None]


@dataclass(frozen=True, eq=False, slots=True)
class PixelMapping:
    """The exact relation between raw and processed pixel coordinates.

    raw_size, size : (width, height) of the raw and of the processed frame, px.
    matrix : (3, 3) float64, homogeneous, from undistorted raw to processed pixels.
    lens : what was taken out before, or None.
    """

    raw_size: tuple[int, int]
    size: tuple[int, int]
    matrix: FloatArray
    lens: Lens | None = None

    @classmethod
    def identity(cls, size: tuple[int, int]) -> PixelMapping:
        """The mapping of a frame of size (width, height) that is left as it is."""
        return cls(size, size, np.eye(3))

    def to_processed(self, points: ArrayLike) -> FloatArray:
        """Where points of the raw frame lie in the processed frame.

        points : (N, 2) or (2,), raw pixels, x right, y down. Returns the same shape, float64, processed
        pixels; points outside the frame are mapped all the same. Raises ValueError on another shape, or for
        coordinates that are not finite.
        """
        given = _points(points)
        raw = given.reshape(-1, 2)
        straight = raw if self.lens is None else self.lens.undistort(raw)
        return _project(self.matrix, straight).reshape(given.shape)

    def to_raw(self, points: ArrayLike) -> FloatArray:
        """Where points of the processed frame lie in the raw frame: inverse of `to_processed`."""
        given = _points(points)
        straight = _project(_inverse(self.matrix), given.reshape(-1, 2))
        return (straight if self.lens is None else self.lens.distort(straight)).reshape(given.shape)


class Preprocessor:
    """Turns raw frames of one size into processed frames, all geometric steps in one pass where exact.

    raw_size : (width, height) of the raw frames, px.
    rotate : 0, 90, 180 or 270, degrees clockwise (the seed's `get_processed_frame` rotates by 90).
    downsample : 1, 2, 4, ...; the factor by which both sides shrink.
    method : "area" averages blocks: fast, and the mean of k x k pixels has 1 / k of their noise. Where a side
        is not a multiple of the factor, the last columns or rows of the unrotated picture are left out.
        "pyramid" is the seed's: rotate, then `cv2.pyrDown` for each factor of two (sides round up); three
        times the time, smoother, and its pixels lie half a raw pixel elsewhere.
    crop : (x, y, width, height), px of the undistorted and rectified, not yet rotated frame; without lens and
        homography these are raw pixels. None keeps everything.
    camera_matrix, distortion, fisheye : the lens, see `Lens`; both or neither must be given.
    homography : (four source points, four destination points, (width, height)), px; source points in the
        undistorted raw frame. What lies outside the raw frame becomes black. Where the whole chain shrinks
        the picture by a factor s, the raw frame is first averaged over blocks of round(s) pixels along each
        axis, so that fine structure is averaged rather than aliased; sampling is bilinear, at positions
        rounded to 1/32 pixel (the same in every frame, so displacements are not affected).

    Raises ValueError for values out of range, a degenerate homography or a crop outside the frame.
    Not to be shared between threads: it reuses intermediate buffers. What it returns is never written again.
    """

    def __init__(
        self,
        raw_size: tuple[int, int],
        *,
        rotate: int = 0,
        downsample: int = 1,
        method: Method = "area",
        crop: tuple[int, int, int, int] | None = None,
        camera_matrix: ArrayLike | None = None,
        distortion: ArrayLike | None = None,
        fisheye: bool = False,
        homography: tuple[ArrayLike, ArrayLike, Sequence[int]] | None = None,
    ) -> None:
        width, height = raw_size
        if width < 1 or height < 1:
            raise ValueError(f"required raw_size (width, height) >= 1, got {raw_size}")
        if rotate not in (0, 90, 180, 270):
            raise ValueError(f"required rotate to be 0, 90, 180 or 270 degrees clockwise, got {rotate}")
        if not _is_whole(downsample) or downsample < 1 or downsample & (downsample - 1):
            raise ValueError(f"required downsample to be 1, 2, 4, 8, ..., got {downsample}")
        if method not in ("area", "pyramid"):
            raise ValueError(f"required method to be 'area' or 'pyramid', got {method!r}")
        lens = check_lens(camera_matrix, distortion, fisheye)
        matrix = np.eye(3)
        size = (int(width), int(height))
        if homography is not None:
            source, destination, target = homography
            if len(target) != 2 or not all(map(_is_whole, target)) or min(target) < 1:
                raise ValueError(f"required a homography size (width, height) >= 1, got {tuple(target)}")
            matrix = find_homography(source, destination)
            size = (int(target[0]), int(target[1]))
        if crop is not None:
            x, y, size = _crop(crop, size)
            matrix = _shift(-x, -y) @ matrix
        else:
            x, y = 0, 0
        if method == "area" and downsample > 1:
            if min(size) < downsample:
                raise ValueError(
                    f"required both sides of the frame >= downsample {downsample}, got width, height {size}"
                )
            size = (size[0] - size[0] % downsample, size[1] - size[1] % downsample)
        self._block = (slice(y, y + size[1]), slice(x, x + size[0]))
        matrix = _rotation(rotate, size) @ matrix
        if rotate in (90, 270):
            size = (size[1], size[0])
        self._levels = downsample.bit_length() - 1
        before_pyramid = PixelMapping((int(width), int(height)), size, matrix, lens)
        for _ in range(self._levels):
            if method == "area":
                matrix = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]]) @ matrix
                size = (size[0] // 2, size[1] // 2)
            else:
                matrix = np.diag([0.5, 0.5, 1.0]) @ matrix
                size = ((size[0] + 1) // 2, (size[1] + 1) // 2)
        self.mapping: PixelMapping = PixelMapping((int(width), int(height)), size, matrix, lens)
        """Exact mapping between raw and processed pixels."""
        self._rotate = rotate
        self._method = method
        self._shrunk: list[NDArray[np.uint8]] = []
        self._resampler: _Resampler | None = None
        if lens is not None or homography is not None:
            self._resampler = _Resampler(self.mapping if method == "area" else before_pyramid)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Process one frame.

        image : (H, W, 3) uint8, of the size given at construction.
        Returns (h, w, 3) uint8 with (w, h) = `mapping.size`; where nothing is to be done, a read-only view
        of `image`. Raises ValueError if the frame has another size, type or number of channels.
        """
        width, height = self.mapping.raw_size
        if image.shape != (height, width, 3) or image.dtype != np.uint8:
            raise ValueError(
                f"required a ({height}, {width}, 3) uint8 frame, got {image.shape} {image.dtype}"
            )
        if self._resampler is not None:
            result: NDArray[Any] = self._resampler(image)
            if self._method == "pyramid":
                result = self._pyramid(result)
            return result
        block: NDArray[Any] = image[self._block]
        if self._method == "pyramid" and self._levels:
            return self._pyramid(block if self._rotate == 0 else cv2.rotate(block, _ROTATIONS[self._rotate]))
        if self._levels:
            block = self._shrink(image)
        if self._rotate:
            return cv2.rotate(block, _ROTATIONS[self._rotate])  # type: ignore[return-value]
        if self._levels:
            return block
        if block.shape == image.shape:
            same = image.view()
            same.flags.writeable = False
            return same
        return np.ascontiguousarray(block)

    def _shrink(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Block averages, by halving: three times as fast as one step of four, for 1/8 grey level of bias."""
        block: tuple[slice, slice] | None = self._block
        for level in range(self._levels):
            if level == self._levels - 1 and self._rotate == 0:
                return halved(image, block, far=level == 0)
            # What is halved or rotated afterwards can live in a buffer of our own.
            if len(self._shrunk) <= level:
                self._shrunk.append(halved(image, block))
            image, block = halved(image, block, into=self._shrunk[level], far=level == 0), None
        return image

    def _pyramid(self, image: NDArray[Any]) -> NDArray[Any]:
        for _ in range(self._levels):
            image = cv2.pyrDown(image)
        return image


class _Resampler:
    """One `cv2.remap` that carries out a whole mapping, with block averaging before it where it shrinks."""

    def __init__(self, mapping: PixelMapping) -> None:
        width, height = mapping.size
        raw_width, raw_height = mapping.raw_size
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        grid = np.column_stack([columns.ravel(), rows.ravel()])
        raw = mapping.to_raw(grid)
        in_front = _in_front(mapping, grid)
        raw[~in_front] = -1e4
        self._block = _shrinkage(mapping, raw.reshape(height, width, 2), in_front.reshape(height, width))
        fx, fy = self._block
        self._small = (raw_width // fx, raw_height // fy)
        self._used = (slice(0, self._small[1] * fy), slice(0, self._small[0] * fx))
        # Inside the raw frame the outermost averaged pixel extends to the frame's edge; outside stays black.
        inside = (
            (raw[:, 0] >= -0.5)
            & (raw[:, 0] <= raw_width - 0.5)
            & (raw[:, 1] >= -0.5)
            & (raw[:, 1] <= raw_height - 0.5)
        )
        small = (raw - [(fx - 1) / 2, (fy - 1) / 2]) / [fx, fy]
        small[inside] = np.clip(small[inside], 0, np.array(self._small) - 1.0)
        small[~inside] = -10.0
        map_x = small[:, 0].reshape(height, width).astype(np.float32)
        map_y = small[:, 1].reshape(height, width).astype(np.float32)
        self._maps: tuple[Any, Any] = (map_x, map_y)
        if max(self._small) <= _LARGEST_FIXED_POINT:
            self._maps = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[Any]:
        source: NDArray[Any] = image
        if self._block != (1, 1):
            source = cv2.resize(image[self._used], self._small, interpolation=cv2.INTER_AREA)
        return cv2.remap(
            source, self._maps[0], self._maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )


def _shrinkage(mapping: PixelMapping, raw: FloatArray, in_front: NDArray[np.bool_]) -> tuple[int, int]:
    """How many raw pixels one processed pixel spans along raw x and raw y, rounded; median over the frame."""
    raw_width, raw_height = mapping.raw_size
    seen = (
        in_front
        & (raw[..., 0] >= -0.5)
        & (raw[..., 0] <= raw_width - 0.5)
        & (raw[..., 1] >= -0.5)
        & (raw[..., 1] <= raw_height - 0.5)
    )
    if not seen.any():
        raise ValueError("required the processed frame to show some of the raw frame, got none of it")
    rows, columns = np.nonzero(seen)
    grid = np.column_stack([columns, rows]).astype(np.float64)
    grid = grid[:: max(1, len(grid) // 2000)]
    half_right, half_down = np.diag([0.5, 0.5])
    right = mapping.to_raw(grid + half_right) - mapping.to_raw(grid - half_right)
    down = mapping.to_raw(grid + half_down) - mapping.to_raw(grid - half_down)
    span = np.median(np.hypot(right, down), axis=0)
    largest = np.array([raw_width, raw_height])
    fx, fy = np.clip(np.rint(span), 1, largest).astype(int)
    return int(fx), int(fy)


def _in_front(mapping: PixelMapping, grid: FloatArray) -> NDArray[np.bool_]:
    """False for processed pixels beyond the horizon of the homography, where it folds over."""
    inverse = _inverse(mapping.matrix)
    depth = grid @ inverse[2, :2] + inverse[2, 2]
    centre = np.array([(mapping.raw_size[0] - 1) / 2, (mapping.raw_size[1] - 1) / 2, 1.0])
    sign = np.sign(mapping.matrix[2] @ centre) or 1.0
    front: NDArray[np.bool_] = depth * sign > 1e-9 * float(np.abs(depth).max())
    return front


def _points(points: ArrayLike) -> FloatArray:
    given = np.asarray(points, dtype=np.float64)
    if given.ndim not in (1, 2) or given.shape[-1:] != (2,):
        raise ValueError(f"required points of shape (N, 2), got {given.shape}")
    if not np.isfinite(given).all():
        raise ValueError("required finite points, got NaN or infinity among them")
    return given


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _project(matrix: FloatArray, points: FloatArray) -> FloatArray:
    homogeneous = points @ matrix[:, :2].T + matrix[:, 2]
    depth = homogeneous[:, 2]
    # A point on the horizon has no finite image; a huge but finite one keeps every later number finite.
    depth = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
    return homogeneous[:, :2] / depth[:, None]


def _inverse(matrix: FloatArray) -> FloatArray:
    return np.linalg.inv(matrix).astype(np.float64)


def _shift(x: float, y: float) -> FloatArray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _rotation(rotate: int, size: tuple[int, int]) -> FloatArray:
    """Matrix of `cv2.rotate` on a picture of size (width, height)."""
    width, height = size
    if rotate == 90:
        return np.array([[0.0, -1.0, height - 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    if rotate == 180:
        return np.array([[-1.0, 0.0, width - 1.0], [0.0, -1.0, height - 1.0], [0.0, 0.0, 1.0]])
    if rotate == 270:
        return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, width - 1.0], [0.0, 0.0, 1.0]])
    return np.eye(3)


def check_lens(camera_matrix: ArrayLike | None, distortion: ArrayLike | None, fisheye: bool) -> Lens | None:
    """The lens of a calibration, or None where neither matrix nor coefficients are given.

    camera_matrix : (3, 3), px. distortion : 4, 5, 8, 12 or 14 coefficients; fisheye: 4.
    Raises ValueError where only one of them is given, or where they do not have these forms.
    """
    if camera_matrix is None and distortion is None:
        if fisheye:
            raise ValueError("required camera_matrix and distortion with fisheye, got neither")
        return None
    if camera_matrix is None or distortion is None:
        missing = "camera_matrix" if camera_matrix is None else "distortion"
        raise ValueError(f"required both camera_matrix and distortion, got no {missing}")
    matrix = np.array(camera_matrix, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise ValueError(f"required a finite 3 x 3 camera_matrix, got shape {matrix.shape}")
    if matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise ValueError(f"required focal lengths > 0 px, got {matrix[0, 0]:g}, {matrix[1, 1]:g}")
    if matrix[1, 0] or not np.array_equal(matrix[2], [0.0, 0.0, 1.0]):
        raise ValueError("required camera_matrix [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], got another form")
    coefficients = np.array(distortion, dtype=np.float64).ravel()
    lengths = (4,) if fisheye else _DISTORTION_LENGTHS
    if len(coefficients) not in lengths:
        wanted = " or ".join(map(str, lengths))
        model = "fisheye" if fisheye else "polynomial"
        raise ValueError(f"required {wanted} {model} distortion coefficients, got {len(coefficients)}")
    if not np.isfinite(coefficients).all():
        raise ValueError(f"required finite distortion coefficients, got {coefficients.tolist()}")
    return Lens(matrix, coefficients, fisheye)


def find_homography(source: ArrayLike, destination: ArrayLike) -> FloatArray:
    """The homography that takes four points to four points.

    source, destination : (4, 2), px, in the same order. Returns (3, 3) float64. Raises ValueError where three
    points lie on a line, or where one outline is crossed and the other is not.
    """
    ends = []
    for name, points in (("source", source), ("destination", destination)):
        corners = np.array(points, dtype=np.float64)
        if corners.shape != (4, 2) or not np.isfinite(corners).all():
            raise ValueError(f"required four finite {name} points (x, y), got shape {corners.shape}")
        extent = float(np.ptp(corners, axis=0).max())
        for left_out in range(4):
            a, b, c = np.delete(corners, left_out, axis=0)
            twice_area = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
            if twice_area <= 1e-6 * extent * extent:
                raise ValueError(
                    f"required {name} points of which no three lie on a line, got {corners.tolist()}"
                )
        ends.append(corners)
    rows = []
    for (x, y), (u, v) in zip(ends[0], ends[1], strict=True):
        rows.append([x, y, 1, 0, 0, 0, -u * x, -u * y])
        rows.append([0, 0, 0, x, y, 1, -v * x, -v * y])
    try:
        solution = np.linalg.solve(np.array(rows), ends[1].ravel())
    except np.linalg.LinAlgError:
        raise ValueError("required points that define a homography, got degenerate ones") from None
    matrix = np.append(solution, 1.0).reshape(3, 3)
    depths = ends[0] @ matrix[2, :2] + 1.0
    if depths.min() * depths.max() <= 0:
        raise ValueError(
            "required source and destination points in the same order around their outline, "
            f"got {ends[0].tolist()} to {ends[1].tolist()}"
        )
    return matrix


def _crop(crop: Sequence[int], size: tuple[int, int]) -> tuple[int, int, tuple[int, int]]:
    if len(crop) != 4 or not all(map(_is_whole, crop)):
        raise ValueError(f"required crop (x, y, width, height) in whole px, got {tuple(crop)}")
    x, y, width, height = (int(value) for value in crop)
    if x < 0 or y < 0 or width < 1 or height < 1 or x + width > size[0] or y + height > size[1]:
        raise ValueError(
            f"required a crop (x, y, width, height) inside the {size[0]} x {size[1]} frame, got {tuple(crop)}"
        )
    return x, y, (width, height)
