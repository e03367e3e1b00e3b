"""Samples of a frame: sums over tiles, and squared differences, of any frame."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.change.tiles import Sample, Tiling
from tests.oracles.tiles import TOLERANCE, plain_sum_tiles

SHAPES = [(1, 1, 3), (1, 50, 3), (50, 1, 3), (31, 33), (61, 47, 1), (90, 70, 2), (241, 317, 3), (600, 64, 4)]


def noise(shape: tuple[int, ...], seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def sample(tiling: Tiling, frame: NDArray[np.uint8]) -> Sample:
    found = Sample(tiling)
    found.take(frame)
    return found


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("tile", [8, 40, 1000])
def test_sums_over_tiles_are_those_of_the_plain_version(shape: tuple[int, ...], tile: int) -> None:
    tiling = Tiling(noise(shape, 0), tile)
    ours = sample(tiling, noise(shape, 1))
    plain = np.empty(tiling.unit.shape, np.float32)
    given = tiling.places, tiling.resting, tiling.slopes, tiling.heap, plain
    plain_sum_tiles(ours.lines(), tiling.used[2], *given)
    assert np.array_equal(ours.sums()[:, :-2], plain[:, :-2])
    np.testing.assert_allclose(ours.sums(), plain, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_squared_differences_are_those_of_the_lines_that_are_read(shape: tuple[int, ...]) -> None:
    one, other = (noise(shape, seed) for seed in (1, 2))
    tiling = Tiling(one, 40)
    difference = np.square(one.astype(np.int64) - other)
    ours, theirs = sample(tiling, one), sample(tiling, other)
    # OpenCV takes the root of the sum, and squares it.
    assert ours.coarse_ssd(theirs) == pytest.approx(difference[tiling.coarse].sum(), rel=1e-12)
    assert ours.ssd(theirs) == pytest.approx(difference[tiling.slice].sum(), rel=1e-12)
    assert difference[tiling.coarse].size == tiling.coarse_count
    assert difference[tiling.slice].size == tiling.count


def test_a_sample_that_takes_another_frame_forgets_the_one_before() -> None:
    first, second = noise((120, 90, 3), 1), noise((120, 90, 3), 2)
    tiling = Tiling(first, 40)
    used, fresh = sample(tiling, first), sample(tiling, second)
    used.sums()
    used.take(second)
    assert np.array_equal(used.sums(), fresh.sums())
    assert used.coarse_ssd(fresh) == used.ssd(fresh) == 0
