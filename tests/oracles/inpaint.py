"""Plain versions of the kernels of inpainting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.markers.inpaint import fill_masked, sum_valid, sum_windows
from tests.oracles.gains import Gain

Bytes = NDArray[np.uint8]
Float = NDArray[np.float32]
Places = NDArray[np.int64]


def plain_sum_valid(
    mask: Bytes, either: Bytes, valid: Bytes, half: Bytes, cells: Float, reach: int, masked: Places
) -> None:
    """Sums over blocks, of what no masked pixel is in."""
    del either
    high, wide = mask.shape
    kept = ~(mask.reshape(high // 2, 2, wide // 2, 2) > 0).any(axis=(1, 3))
    valid[:] = 255 * kept.ravel().astype(np.uint8)
    half.reshape(high // 2, wide // 2, 3)[~kept] = 0
    four = np.dstack([half.reshape(high // 2, wide // 2, 3), valid.reshape(high // 2, wide // 2)])
    sums = four.reshape(high // 4, 2, wide // 4, 2, 4).sum(axis=(1, 3), dtype=np.float32)
    sections = cells.reshape(len(cells), 4, -1)
    sections[reach : reach + high // 4, :, reach : reach + wide // 4] = sums.transpose(0, 2, 1)
    masked[:] = (sums[:, :, 3] < 4 * 255).sum(axis=1)


def plain_sum_windows(
    cells: Float,
    reach: int,
    rows: Places,
    columns: Places,
    far: float,
    least: float,
    lines: Float,
    sums: Float,
) -> int:
    """Sums of shifted copies of the lines, which are long enough to run over their sections."""
    del lines
    height, section = len(sums), columns.size
    cells[:] = cells.reshape(len(cells), 4, section)[rows][:, :, columns].reshape(len(cells), -1)
    count = cells.shape[1] - 2 * reach
    wide = np.lib.stride_tricks.sliding_window_view(cells, 2 * reach + 1, axis=0).sum(axis=2)
    wide = np.lib.stride_tricks.sliding_window_view(wide, 2 * reach + 1, axis=1).sum(axis=2)
    near = cells[reach - 1 :][:height] + 2 * cells[reach:][:height] + cells[reach + 1 :][:height]
    near = near[:, reach - 1 :][:, :count] + 2 * near[:, reach:][:, :count] + near[:, reach + 1 :][:, :count]
    sums[:, :count] = near + np.float32(far) * wide
    return int((sums[:, 3 * section : 4 * section - 2 * reach] < np.float32(least)).sum())


def plain_fill_masked(
    mask: Bytes, masked: Places, sums: Float, section: int, line: Float, fill: Bytes, picture: Bytes
) -> None:
    """Quotients, interpolated linearly to twice their number, every pixel four times, under the mask."""
    del masked, line, fill
    height, width = sums.shape[0], mask.shape[1] // 4
    sections = sums.reshape(height, 4, section)[:, :, :width]
    sections[:, :3] *= np.float32(255) / sections[:, 3:]
    filled = sections[:, :3].transpose(0, 2, 1)
    for axis in (0, 1):
        filled = np.moveaxis(filled, axis, 0)
        before, after = np.concatenate([filled[:1], filled[:-1]]), np.concatenate([filled[1:], filled[-1:]])
        most = np.float32(0.75) * filled
        finer = np.stack([most + np.float32(0.25) * before, most + np.float32(0.25) * after], axis=1)
        filled = np.moveaxis(finer.reshape(-1, *filled.shape[1:]), 0, axis)
    large = np.rint(filled).astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)
    hidden = mask > 0
    picture.reshape(*mask.shape, 3)[hidden] = large[hidden]


GAINS = [
    Gain(sum_valid, plain_sum_valid, scratch=("either",)),
    # Sums below 1e6 in float32.
    Gain(sum_windows, plain_sum_windows, tolerance=0.1, scratch=("lines",)),
    Gain(fill_masked, plain_fill_masked, scratch=("line", "fill")),
]
