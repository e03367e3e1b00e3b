"""The tracker's compiled loops against the numpy and OpenCV they stand for."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.stages.tracker import Tracker
from tactflow.vision import compiled
from tactflow.vision.markers import matching, template_kernels, tracking_kernels
from tactflow.vision.markers.detection import Detection, detect_markers, neighbour_graph, to_gray
from tactflow.vision.markers.matching import choose_spots
from tactflow.vision.markers.template import MarkerAppearance
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers
from tests.vision.dots import FloatArray, grid, render

SIZE = (150, 170)
PITCH = 24.0
TRUTH = grid(7, 6, PITCH, corner=(14.3, 13.8), jitter=0.4)


@pytest.fixture(autouse=True)
def _numba() -> None:
    if not compiled.active():
        pytest.skip('numba is not here: pip install "tactflow[fast]"')


def picture(centers: FloatArray, seed: int = 0) -> NDArray[np.uint8]:
    return render(SIZE, centers, 3.4, noise=1.0, seed=seed)


@cache
def reference() -> tuple[NDArray[np.uint8], Detection]:
    frame = picture(TRUTH, seed=99)
    return frame, detect_markers(frame)


def appearance(dark: bool = True) -> MarkerAppearance:
    frame, detection = reference()
    return MarkerAppearance(to_gray(frame).astype(np.float32), detection.centers, detection.dot_radius, dark)


def check_measures(
    under_test: MarkerAppearance,
    image: NDArray[np.uint8],
    start: FloatArray,
    marks: NDArray[np.int64] | None = None,
    rounding: float = 2e-5,
) -> None:
    found = under_test.measure(under_test.view(image), start, marks)
    with compiled.switched(False):
        expected = under_test.measure(under_test.view(image), start, marks)
    for one, other in zip(found, expected, strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
    # Sums of some hundred products in float32, in another order: relative errors of 1e-6; measured 7e-7 px,
    # 6e-6 for gain and share, 3e-6 px for standard errors.
    np.testing.assert_allclose(found[0], expected[0], atol=5e-6)
    np.testing.assert_allclose(found[1], expected[1], atol=2e-5)
    np.testing.assert_allclose(found[2], expected[2], atol=rounding)
    np.testing.assert_allclose(found[3], expected[3], atol=1e-5, rtol=rounding)


# Where a patch has hardly any contrast beside its light, what the mark leaves unexplained is a difference of
# sums up to 1e6 times as large, whose rounding shows: measured 1.2e-3 of it.
FLAT = 5e-3


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0, 60.0])
def test_marks_measure_alike_wherever_the_search_starts(spread: float, dark: bool) -> None:
    rng = np.random.default_rng(int(10 * spread))
    under_test = appearance(dark)
    start = reference()[1].centers + rng.normal(0, 1, (42, 2)) * spread
    image = picture(TRUTH + rng.normal(0, 0.7, TRUTH.shape), seed=3)
    rounding = FLAT if spread > 10 else 2e-5
    check_measures(under_test, image, start, rounding=rounding)
    check_measures(under_test, to_gray(image), start, rounding=rounding)
    some = np.array([5, 41, 0, 17])
    check_measures(under_test, image, start[some], some, rounding=rounding)


def test_marks_measure_alike_at_and_beyond_the_border() -> None:
    width, height = SIZE
    places = np.array(
        [
            [x, y]
            for x in (-500.0, -0.4, 0.0, 0.6, width - 8.0, width - 6.0, width - 4.0, width + 300.0)
            for y in (-9.0, 2.5, 70.0, height - 5.0, 1e7)
        ]
    )
    marks = np.arange(len(places))
    image = np.random.default_rng(1).integers(0, 256, (height, width, 3)).astype(np.uint8)
    check_measures(appearance(), image, places, marks)
    check_measures(appearance(), to_gray(image), places, marks)


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (7, 1), (3, 2)])
def test_marks_measure_alike_in_pictures_smaller_than_a_patch(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(size))
    image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
    origin = rng.uniform(0, max(size), (3, 2))
    under_test = MarkerAppearance(to_gray(image).astype(np.float32), origin, 2.0)
    check_measures(under_test, image, origin, rounding=FLAT)


def test_a_starting_point_that_is_no_number_reads_inside_the_picture() -> None:
    frame, detection = reference()
    under_test = appearance()
    start = detection.centers.copy()
    start[3] = np.nan
    found = under_test.measure(under_test.view(frame), start)
    assert all(np.isfinite(part).all() for part in found)


def test_grey_is_that_of_opencv_to_the_last_level() -> None:
    # All colours whose weighted sum lies at a rounding boundary of the fixed-point luma.
    blue, green, red = np.meshgrid(*[np.arange(256)] * 3, indexing="ij")
    close = (3735 * blue + 19235 * green + 9798 * red + 16384 + 24) % 32768 < 48
    colours = np.stack([blue[close], green[close], red[close]], axis=1).astype(np.uint8)
    width, height = SIZE
    assert len(colours) > width * height / 2
    under_test, start = appearance(), reference()[1].centers
    for seed in range(3):
        image = np.random.default_rng(seed).permutation(np.resize(colours, (width * height, 3)))
        image = image.reshape(height, width, 3)
        coloured = under_test.measure(under_test.view(image), start)
        grey = under_test.measure(under_test.view(to_gray(image)), start)
        for one, other in zip(coloured, grey, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("seed", range(6))
def test_marks_are_judged_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    under_test = MarkerTracker(*reference())
    doubts = set()
    for trial in range(60):
        size = rng.choice([0.05, 0.5, 4.0])
        share = np.where(rng.random(42) < rng.choice([0.0, 0.1]), 0.4, 0.9).astype(np.float32)
        gain = np.where(rng.random(42) < rng.choice([0.0, 0.02]), 3.5, 1.0).astype(np.float32)
        under_test._position = under_test._origin + rng.normal(0, 0.3, (42, 2))
        under_test._seen = rng.random(42) < rng.choice([0.0, 0.9, 1.0])
        position = under_test._position + rng.normal(0, size, (42, 2))
        if trial % 4 == 0:
            position += np.array([2.0, -1.0])
        found = under_test._judge(position, gain, share)
        with compiled.switched(False):
            expected = under_test._judge(position, gain, share)
        np.testing.assert_array_equal(found[0], expected[0])
        # The same operations; numpy may fuse a product and a sum, which spares one rounding.
        np.testing.assert_allclose(found[1], expected[1], rtol=1e-14)
        assert found[2] == expected[2]
        doubts.add(found[2])
        part = under_test._largest_part(found[0], found[1])
        with compiled.switched(False):
            np.testing.assert_array_equal(part, under_test._largest_part(found[0], found[1]))
    assert doubts == {0, 1, 2}


def test_parts_of_several_grids_are_found_alike() -> None:
    rng = np.random.default_rng(4)
    first, second = grid(4, 4, 12.0, corner=(10.0, 10.0)), grid(5, 4, 12.0, corner=(90.0, 70.0))
    centers = np.concatenate([first, second])
    edges = np.concatenate([neighbour_graph(first, 30.0), neighbour_graph(second, 30.0) + 16])
    under_test = MarkerTracker(picture(centers), Detection(centers, 3.0, "dark", 12.0, edges))
    sizes = set()
    for _ in range(200):
        seen, stretch = rng.random(36) < 0.8, rng.uniform(0, rng.choice([0.4, 0.8]), len(edges))
        part = under_test._largest_part(seen, stretch)
        with compiled.switched(False):
            np.testing.assert_array_equal(part, under_test._largest_part(seen, stretch))
        assert part[:16].any()
        assert part[16:].any()
        sizes.add(int(part.sum()))
    assert len(sizes) > 5


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 3), (5, 40), (41, 37)])
def test_peaks_are_the_same_pixels_and_vertices(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[1])
    spots = MarkerTracker(*reference())._spots
    pictures = [
        np.zeros(shape, np.float32),
        np.ones(shape, np.float32),
        rng.normal(0, 1, shape).astype(np.float32),
        rng.integers(0, 3, shape).astype(np.float32),
        np.asarray(cv2.GaussianBlur(rng.normal(0, 9, shape).astype(np.float32), (0, 0), 1.5), np.float32),
    ]
    for response in pictures:
        for least in (-1.0, 0.0, 0.7):
            found = spots._peaks(response, least)
            with compiled.switched(False):
                expected = spots._peaks(response, least)
            # Single operations in the same precision and order: the same bits.
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, other)


def test_more_peaks_than_there_is_room_for_are_found_too() -> None:
    spots = MarkerTracker(*reference())._spots
    # On a plateau every pixel is as high as all around it.
    points, _ = spots._peaks(np.ones((60, 50), np.float32), 0.5)
    assert len(points) == 58 * 48


def test_nearness_is_the_same() -> None:
    rng = np.random.default_rng(9)
    under_test = MarkerTracker(*reference())
    both = 0
    for _ in range(300):
        points, others = (rng.uniform(-40, 200, (rng.integers(0, 40), 2)) for _ in range(2))
        disc = under_test._disc(float(rng.uniform(0.1, 1.2)))
        found = under_test._near(points, others, disc)
        with compiled.switched(False):
            np.testing.assert_array_equal(found, under_test._near(points, others, disc))
        both += int(found.any() and not found.all())
    assert both > 100


def test_spots_are_chosen_alike() -> None:
    rng = np.random.default_rng(0)
    jointly = 0
    for _ in range(800):
        columns, rows = rng.integers(1, 9, 2)
        origin = grid(int(rows), int(columns), 20.0, corner=(0.0, 0.0)) + rng.normal(
            0, 0.4, (rows * columns, 2)
        )
        edges = neighbour_graph(origin, 52.0)
        moved = rng.normal(0, rng.choice([0.1, 3.0, 8.0]), (1, 2))
        moved = moved + rng.normal(0, rng.choice([0.1, 1.0, 5.0, 14.0]), origin.shape)
        settled = rng.random(len(origin)) < rng.choice([0.0, 0.3, 0.7])
        free = np.flatnonzero(~settled & (rng.random(len(origin)) < rng.choice([0.9, 1.0])))
        spots = (origin + moved)[free][rng.random(len(free)) < rng.choice([0.4, 0.8, 1.0])]
        spots = np.concatenate([spots, rng.uniform(-20, 200, (rng.integers(0, 6), 2))])
        strength = rng.uniform(0.3, 1.3, len(spots))
        expected = np.stack([origin[free], origin[free] + moved.mean(axis=0)])
        chosen = []
        for on in (True, False):
            with compiled.switched(on):
                chosen.append(
                    choose_spots(
                        origin,
                        edges,
                        free,
                        settled,
                        moved,
                        expected,
                        spots,
                        strength,
                        pitch=20.0,
                        farthest=26.0,
                    )
                )
        # Costs differ in their last digits, so only an exact draw between two choices could fall otherwise.
        np.testing.assert_array_equal(chosen[0], chosen[1])
        jointly += int((chosen[0] >= 0).sum() > 3)
    assert jointly > 400


@pytest.mark.parametrize(
    ("edges", "free"), [([[0, 2]], [0]), ([[-1, 0]], [0]), ([[0, 1]], [2]), ([[0, 1]], [-1])]
)
def test_marks_that_are_not_there_are_refused(edges: list[list[int]], free: list[int]) -> None:
    origin = np.array([[0.0, 0.0], [10.0, 0.0]])
    with pytest.raises(IndexError, match="required marks 0 to 1 in edges and free"):
        choose_spots(
            origin, np.array(edges), np.array(free), np.zeros(2, bool), np.zeros((2, 2)), origin[None, :1],
            origin, np.ones(2), pitch=10.0, farthest=13.0,
        )  # fmt: skip


def test_the_stage_has_its_loops_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    loops = [
        loop
        for module in (template_kernels, matching, tracking_kernels)
        for loop in vars(module).values()
        if isinstance(loop, compiled.Kernel)
    ]
    assert len(loops) == 7
    for loop in loops:
        monkeypatch.setattr(loop, "_compiled", None)
    Tracker(Tracker.Params())
    assert all(loop._compiled is not None for loop in loops)


def _sequence(jumpy: bool) -> list[NDArray[np.uint8]]:
    rng = np.random.default_rng(21)
    frames = []
    for step in range(40):
        bend = np.exp(-((TRUTH - SIZE[0] / 2) ** 2).sum(axis=1) / (2 * 50.0**2))
        shift = np.array([0.4 * step, 6.0 * np.sin(step / 5)])
        if jumpy:
            angle = rng.uniform(0, 2 * np.pi)
            shift = rng.uniform(0, 0.9) * PITCH * np.array([np.cos(angle), np.sin(angle)])
            bend = bend if step % 3 else np.ones_like(bend)
        now = TRUTH + bend[:, None] * shift
        if step % 2:
            now = now[rng.random(len(now)) > 0.08]
        if step % 5 == 0:
            now = np.concatenate([now, rng.uniform(10, 140, (4, 2))])
        frames.append(picture(now, seed=step))
    return frames


@pytest.mark.parametrize("jumpy", [False, True])
def test_a_recording_is_tracked_alike(jumpy: bool) -> None:
    frames = _sequence(jumpy)
    runs: list[list[Markers]] = []
    for on in (True, False):
        with compiled.switched(on):
            under_test = MarkerTracker(*reference())
            runs.append([under_test.track(frame) for frame in frames])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.status, other.status)
        # Differences do not add up, as every position is measured against the reference: measured 4e-7 px and
        # 2e-6 px.
        np.testing.assert_allclose(one.position, other.position, atol=1e-5)
        np.testing.assert_allclose(one.stderr, other.stderr, atol=2e-5)
    assert any((markers.status != 0).any() for markers in runs[0])
