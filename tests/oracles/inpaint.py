"""Plain versions of the kernels of inpainting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.inpaint import fill_masked, sum_valid, sum_windows
from tests.oracles.gains import Gain

Bytes = NDArray[np.uint8]
Float = NDArray[np.float32]
Sums = NDArray[np.uint16]
Places = NDArray[np.int64]
Flags = NDArray[np.bool_]


def plain_sum_valid(
    mask: Bytes,
    half: Bytes,
    columns: Places,
    either: Bytes,
    valid: Bytes,
    sums: Sums,
    cells: Sums,
    masked: Flags,
) -> None:
    """Sums over blocks, of what no masked pixel is in."""
    del either, valid, sums
    high, wide = mask.shape
    kept = ~(mask.reshape(high // 2, 2, wide // 2, 2) > 0).any(axis=(1, 3))
    four = np.dstack([half.reshape(high // 2, wide // 2, 3), np.full(kept.shape, 255)]) * kept[:, :, None]
    blocks = four.reshape(high // 4, 2, wide // 4, 2, 4).sum(axis=(1, 3)).transpose(0, 2, 1)
    reach = (columns.size - wide // 4) // 2
    cells.reshape(high // 4, 4, -1)[:, :, : columns.size] = blocks[:, :, columns - reach]
    masked[:] = (mask.reshape(high // 4, -1) > 0).any(axis=1)


def plain_sum_windows(
    cells: Sums,
    masked: Flags,
    rows: Places,
    reach: int,
    width: int,
    far: float,
    least: float,
    tall: Sums,
    near: Sums,
    windows: Float,
) -> bool:
    """Sums of shifted copies of the lines, where a line or one beside it is masked."""
    del tall, near
    long = cells.shape[1]
    lines = np.pad(cells[rows].astype(np.int64), ((0, 0), (0, 2 * reach)))
    far_sums = np.lib.stride_tricks.sliding_window_view(lines[1:-1], 2 * reach + 1, axis=0).sum(axis=2)
    far_sums = np.lib.stride_tricks.sliding_window_view(far_sums, 2 * reach + 1, axis=1).sum(axis=2)
    around = lines[reach:-reach]
    around = (around[:-2] + 2 * around[1:-1] + around[2:])[:, reach - 1 :]
    near_sums = around[:, :long] + 2 * around[:, 1 : long + 1] + around[:, 2 : long + 2]
    sums = near_sums.astype(np.float32) + np.float32(far) * far_sums.astype(np.float32)
    looked_at = _or_beside(masked)
    windows[looked_at] = sums[looked_at]
    return bool((sums[looked_at, 3 * long // 4 :][:, :width] < np.float32(least)).any())


def plain_fill_masked(
    mask: Bytes, masked: Flags, windows: Float, line: Float, fill: Bytes, picture: Bytes
) -> None:
    """Quotients, interpolated linearly to twice their number, every pixel four times, under the mask."""
    del line, fill
    height, width = len(windows), mask.shape[1] // 4
    sections, looked_at = windows.reshape(height, 4, -1)[:, :, :width], _or_beside(masked)
    # What is not looked at is of another frame.
    with np.errstate(divide="ignore", invalid="ignore"):
        sections[looked_at, :3] *= np.float32(255) / sections[looked_at, 3:]
        filled = sections[:, :3].transpose(0, 2, 1)
        for axis in (0, 1):
            filled = np.moveaxis(filled, axis, 0)
            before = np.concatenate([filled[:1], filled[:-1]])
            after = np.concatenate([filled[1:], filled[-1:]])
            most = np.float32(0.75) * filled
            finer = np.stack([most + np.float32(0.25) * before, most + np.float32(0.25) * after], axis=1)
            filled = np.moveaxis(finer.reshape(-1, *filled.shape[1:]), 0, axis)
    hidden = mask > 0
    large = np.rint(filled.repeat(2, axis=0).repeat(2, axis=1)[hidden])
    picture.reshape(*mask.shape, 3)[hidden] = large.astype(np.uint8)


def _or_beside(masked: Flags) -> Flags:
    """Which lines are masked, or beside one that is."""
    wide = np.pad(masked, 1)
    return np.asarray(wide[:-2] | wide[1:-1] | wide[2:], np.bool_)


GAINS = [
    Gain(sum_valid, plain_sum_valid, scratch=("either", "valid", "sums")),
    Gain(sum_windows, plain_sum_windows, scratch=("tall", "near")),
    Gain(fill_masked, plain_fill_masked, scratch=("line", "fill")),
]
