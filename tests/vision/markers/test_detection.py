"""Detection of marks, against dots drawn at known places and on real gels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.sim import open_scene
from tactflow.vision.markers.detection import NoMarkersError, detect_markers, to_gray
from tactflow.vision.markers.lattice import neighbour_graph
from tests.vision.dots import grid, match, rectified, render


@pytest.mark.parametrize(
    ("rows", "columns", "pitch", "radius", "shape", "bright"),
    [
        (10, 8, 34.0, 4.6, "round", False),
        (10, 8, 34.0, 4.6, "round", True),
        (10, 8, 34.0, 4.6, "square", False),
        (10, 8, 34.0, 5.0, "doubled", False),
        (26, 20, 14.3, 2.0, "round", False),
        (5, 5, 55.0, 6.0, "round", False),
        (14, 10, 20.0, 2.6, "round", False),
        (9, 9, 30.0, 9.0, "round", False),
    ],
)
def test_every_mark_is_found_once_at_its_centre(
    rows: int, columns: int, pitch: float, radius: float, shape: str, bright: bool
) -> None:
    truth = grid(rows, columns, pitch, corner=(17.3, 21.6), jitter=0.3)
    image = render((300, 400), truth, radius, shape=shape, bright=bright, noise=1.0)
    detection = detect_markers(image)
    which, away = match(detection.centers, truth)
    assert sorted(which) == list(range(len(truth)))
    # Measured: 0.01 to 0.03 px RMS, most of it from the slope of the light; the largest was 0.09 px.
    assert np.sqrt(np.mean(away**2)) < 0.05
    assert detection.polarity == ("bright" if bright else "dark")
    assert detection.pitch == pytest.approx(pitch, rel=0.06)


def test_marks_in_no_regular_grid_are_found() -> None:
    truth = grid(10, 8, 34.0, corner=(25, 30), jitter=4.0)
    detection = detect_markers(render((300, 400), truth, 4.6, noise=1.0))
    which, away = match(detection.centers, truth)
    assert sorted(which) == list(range(80))
    assert away.max() < 0.15


@pytest.mark.parametrize("column", [105, 110, 115])
def test_a_dead_column_of_the_camera_holds_no_marks(column: int) -> None:
    truth = grid(14, 10, 20.0, corner=(17.3, 21.6), jitter=0.3)
    image = render((300, 400), truth, 2.6, noise=4.0)
    image[:, column] = 0
    which, _ = match(detect_markers(image).centers, truth)
    assert sorted(which) == list(range(len(truth)))


def painted(sizes: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """A grid of 8 x 10 dots, each of its own size."""
    truth = grid(8, 10, 36.0, corner=(35, 30), jitter=1.5)
    image = np.full((320, 400, 3), 255, np.uint8)
    for size in np.unique(sizes):
        image = np.minimum(image, render((400, 320), truth[sizes == size], float(size), noise=1.0))
    return truth, image


def test_dots_painted_in_many_sizes_are_all_found_and_large_ones_as_such() -> None:
    sizes = np.random.default_rng(3).choice([3.5, 4.5, 9.0], 80, p=[0.4, 0.4, 0.2])
    truth, image = painted(sizes)
    detection = detect_markers(image)
    which, away = match(detection.centers, truth)
    assert sorted(which) == list(range(80))
    assert away.max() < 0.25
    assert detection.radii is not None
    large = sizes[which] == 9.0
    assert detection.radii[large] == pytest.approx(9.0, rel=0.25)
    assert (detection.radii[~large] < 6.5).all()


def test_dots_that_shrink_in_perspective_are_all_found() -> None:
    flat = grid(10, 14, 1.0, corner=(-6.5, 0))
    depth = 1.0 + 0.12 * flat[:, 1]
    truth = np.column_stack([320 + 44 * flat[:, 0] / depth, 30 + 400 * (1 - 1 / depth) / 0.52])
    image = np.full((480, 640, 3), 255, np.uint8)
    for row in range(10):
        dots = truth[14 * row : 14 * row + 14]
        image = np.minimum(image, render((640, 480), dots, 9.0 / depth[14 * row], noise=1.0))
    detection = detect_markers(image)
    which, _ = match(detection.centers, truth)
    assert sorted(which) == list(range(140))


def test_dots_that_crowd_each_other_are_found_where_the_lattice_wants_them() -> None:
    # Rendered eight times as large: radius 1 px, 3.5 px apart, so that the ring around each meets others.
    large = grid(10, 12, 28.0, corner=(40, 40), jitter=1.5)
    image = cv2.resize(render((384, 328), large, 8.0, bright=True), (48, 41), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0, 2, image.shape)
    detection = detect_markers(np.clip(image + noise, 0, 255).astype(np.uint8))
    which, away = match(detection.centers, (large + 0.5) / 8 - 0.5)
    assert len(set(which)) == len(detection.centers) >= 115
    assert away.max() < 0.5


def test_a_few_lamps_are_not_preferred_to_many_faint_dots() -> None:
    truth = grid(9, 13, 24.0, corner=(50, 50), jitter=0.5)
    lamps = np.array([[70.0 + 80 * n, y] for n in range(3) for y in (15.0, 275.0)])
    image = render((400, 290), truth, 3.5, bright=True, contrast=0.12, noise=1.0)
    image = np.maximum(image, render((400, 290), lamps, 9.0, bright=True, light=0.0, contrast=1.0))
    assert len(detect_markers(image).centers) == 117


def with_lamps(gain: float) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Bright dots; and beside them lamps that saturate the camera, where a row might go on."""
    dots = grid(8, 9, 24, corner=(25, 32))
    image = render((240, 230), dots, 4, bright=True, noise=1)
    image = np.asarray(cv2.convertScaleAbs(image, alpha=gain), np.uint8)
    for x in range(37, 200, 48):
        cv2.circle(image, (x, 8), 5, (255, 255, 255), cv2.FILLED, cv2.LINE_AA)
    return dots, image


def test_lamps_beside_bright_marks_are_no_marks() -> None:
    dots, image = with_lamps(gain=1.0)
    which, away = match(detect_markers(image).centers, dots)
    assert sorted(which) == list(range(len(dots)))
    assert away.max() < 0.5


def test_marks_as_bright_as_lamps_are_still_marks() -> None:
    dots, image = with_lamps(gain=1.5)
    _, away = match(dots, detect_markers(image).centers)
    assert away.max() < 0.5


@pytest.mark.parametrize("pitch", [8, 24])
@pytest.mark.parametrize("kind", ["threads", "uneven threads", "checks"])
def test_the_crossings_of_a_cloth_are_refused_in_words(kind: str, pitch: int) -> None:
    y, x = np.mgrid[: 15 * pitch, : 20 * pitch] / pitch
    warp, weft = np.sin(2 * np.pi * x), np.sin(2 * np.pi * y)
    cloth = {
        "threads": warp + weft,
        "uneven threads": 1.3 * warp + 0.7 * weft,
        "checks": np.sign(warp * weft),
    }[kind]
    picture = 128 + 30 * cloth + np.random.default_rng(0).normal(0, 1.5, cloth.shape)
    with pytest.raises(NoMarkersError, match="run into each other") as refused:
        detect_markers(picture.astype(np.uint8))
    assert refused.value.best is not None


def test_dashes_that_touch_along_a_line_are_marks() -> None:
    y, x = np.mgrid[:360, :480]
    away = np.hypot((x % 24 - 12) / 1.9, y % 24 - 12)
    picture = np.clip(160 - 100 * np.clip(6.5 - away, 0, 1), 0, 255).astype(np.uint8)
    assert len(detect_markers(picture).centers) > 0.8 * 20 * 15


@pytest.mark.parametrize("kind", ["speckle", "waves", "scattered"])
def test_a_random_texture_is_refused_in_words(kind: str) -> None:
    rng = np.random.default_rng(4)
    waves = cv2.GaussianBlur(rng.normal(size=(360, 480)), (0, 0), 3.0)
    waves -= cv2.GaussianBlur(waves, (0, 0), 6.0)
    waves /= waves.std()
    if kind == "speckle":
        texture = np.where(waves > 0.8, 40, 180).astype(np.uint8)
    elif kind == "waves":
        texture = np.clip(128 + 40 * waves, 0, 255).astype(np.uint8)
    else:
        texture = render((480, 360), rng.uniform((8, 8), (472, 352), (300, 2)), 4.0, noise=1.0)
    with pytest.raises(NoMarkersError, match=r"form no lattice: \d+ % of their parallelograms") as refused:
        detect_markers(texture)
    assert refused.value.best is not None


def test_several_grids_in_one_picture_are_all_found() -> None:
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    grids = [
        grid(6, 6, 26.0, corner=(30, 30)),
        grid(6, 5, 22.0, corner=(0, 0)) @ turn + (360, 40),
        grid(5, 7, 30.0, corner=(120, 280)),
    ]
    truth = np.concatenate(grids)
    which, _ = match(detect_markers(render((520, 440), truth, 4.0, noise=1.0)).centers, truth)
    assert sorted(which) == list(range(len(truth)))


def test_dark_and_bright_marks_that_are_as_good_are_told_apart_by_polarity() -> None:
    dark = grid(7, 7, 34.0, corner=(30, 30))
    image = render((270, 270), dark, 4.0, contrast=0.5, light=110.0)
    other = render((270, 270), dark[:42] + 17.0, 4.0, bright=True, light=0.0, contrast=0.2)
    both = np.clip(image.astype(int) + other, 0, 255).astype(np.uint8)
    with pytest.raises(NoMarkersError, match=r"49 dark ones .* are as regular as 42 bright ones"):
        detect_markers(both)
    assert len(detect_markers(both, polarity="dark").centers) == 49
    assert len(detect_markers(both, polarity="bright").centers) == 42


def test_centres_come_in_reading_order() -> None:
    truth = grid(4, 6, 30.0, corner=(40, 40), jitter=0.5)
    which, _ = match(detect_markers(render((260, 200), truth, 4.0)).centers, truth)
    assert which.tolist() == list(range(24))


def test_marks_cut_by_the_border_are_left_out() -> None:
    truth = grid(8, 8, 30.0, corner=(0.5, 25.0))
    detection = detect_markers(render((260, 270), truth, 4.0))
    assert len(detection.centers) == 56
    assert detection.centers[:, 0].min() > 20


def test_faint_dirt_between_the_marks_is_left_out() -> None:
    truth = grid(8, 8, 30.0, corner=(25.0, 25.0))
    dirt = truth[[9, 18, 30]] + (14.0, 13.0)
    contrast = np.concatenate([np.full(64, 0.8), np.full(3, 0.2)])
    image = render((260, 260), np.concatenate([truth, dirt]), 4.0, contrast=contrast)
    assert len(detect_markers(image).centers) == 64


def test_edges_and_lines_are_not_marks() -> None:
    truth = grid(7, 7, 30.0, corner=(60.0, 60.0))
    image = render((300, 300), truth, 4.0, noise=1.0)
    image[:, :25] = 5
    image[:20] = 250
    cv2.line(image, (30, 275), (295, 270), (20, 20, 20), 3)
    assert len(detect_markers(image).centers) == 49


@pytest.mark.parametrize("kind", ["flat", "noise", "slope", "tiny"])
def test_a_gel_without_marks_is_an_error_with_advice(kind: str) -> None:
    image = np.full((200, 150, 3), 120, np.uint8)
    if kind == "noise":
        image = np.random.default_rng(2).normal(120, 6, image.shape).clip(0, 255).astype(np.uint8)
    elif kind == "slope":
        image = np.broadcast_to(np.linspace(10, 240, 150).astype(np.uint8)[:, None], (200, 150, 3)).copy()
    elif kind == "tiny":
        image = image[:5, :4]
    advice = r"^0 markers found: .*then use the pipeline markerless\b.*\(tactflow pipelines\)"
    with pytest.raises(NoMarkersError, match=advice):
        detect_markers(image)


def test_marks_are_only_looked_for_where_there_is_gel() -> None:
    truth = grid(8, 8, 30.0, corner=(25.0, 25.0))
    image = render((260, 260), truth, 4.0)
    valid = np.full((260, 260), 255, np.uint8)
    valid[:, :100] = 0
    assert len(detect_markers(image, valid=valid).centers) == np.count_nonzero(truth[:, 0] > 100)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_marks_are_found_when_their_radius_is_given(count: int) -> None:
    truth = np.array([[50.3, 60.7], [120.2, 61.1], [90.0, 130.4]])[:count]
    image = render((180, 170), truth, 5.0)
    with pytest.raises(NoMarkersError, match="give their radius"):
        detect_markers(image)
    detection = detect_markers(image, dot_radius=5.0)
    _, away = match(detection.centers, truth)
    assert len(detection.centers) == count
    assert away.max() < 0.1


def test_gain_and_offset_of_the_light_do_not_move_centres() -> None:
    truth = grid(8, 8, 30.0, corner=(25.0, 25.0), jitter=0.5)
    image = render((260, 260), truth, 4.0)
    other = np.rint(0.7 * image + 40).astype(np.uint8)
    first, second = detect_markers(image).centers, detect_markers(other).centers
    # Rounding to grey levels is all that differs: measured 0.008 px at most.
    np.testing.assert_allclose(first, second, atol=0.03)


@pytest.mark.parametrize("turn", ["mirror", "upside_down", "transpose"])
def test_a_turned_picture_has_turned_centres(turn: str) -> None:
    truth = grid(7, 9, 28.0, corner=(23.4, 26.1), jitter=0.5)
    image = render((271, 223), truth, 4.0, noise=1.0)
    width, height = 270, 222
    turned, back = {
        "mirror": (image[:, ::-1], lambda c: c * (-1, 1) + (width, 0)),
        "upside_down": (image[::-1], lambda c: c * (1, -1) + (0, height)),
        "transpose": (image.transpose(1, 0, 2), lambda c: c[:, ::-1]),
    }[turn]
    original, found = detect_markers(image), detect_markers(turned)
    which, away = match(back(found.centers), original.centers)
    assert sorted(which) == list(range(63))
    # The same sums in another order, in single precision up to the peaks: measured 1e-6 px.
    assert away.max() < 1e-3


def test_read_only_and_strided_pictures_give_the_same_and_stay_untouched() -> None:
    truth = grid(6, 6, 30.0, corner=(25.0, 25.0))
    image = render((203, 201), truth, 4.0)
    wide = np.repeat(image, 2, axis=1)
    view = wide[:, ::2]
    view.flags.writeable = False
    before = view.copy()
    np.testing.assert_array_equal(detect_markers(view).centers, detect_markers(image).centers)
    np.testing.assert_array_equal(view, before)


def test_gray_pictures_are_accepted() -> None:
    image = render((203, 201), grid(6, 6, 30.0, corner=(25.0, 25.0)), 4.0)
    np.testing.assert_array_equal(detect_markers(to_gray(image)).centers, detect_markers(image).centers)


@pytest.mark.parametrize(
    ("image", "options", "words"),
    [
        (np.zeros((50, 50, 3), np.float32), {}, "uint8"),
        (np.zeros((50, 50, 4), np.uint8), {}, r"\(H, W, 3\)"),
        (np.zeros((0, 50, 3), np.uint8), {}, "non-empty"),
        (np.zeros((80, 80, 3), np.uint8), {"dot_radius": 0.5}, "dot_radius 1 to 20 px, got 0.5"),
        (np.zeros((80, 80, 3), np.uint8), {"dot_radius": 40.0}, "dot_radius 1 to 20 px, got 40"),
        (np.zeros((80, 80, 3), np.uint8), {"polarity": "red"}, "polarity"),
        (
            np.zeros((80, 80, 3), np.uint8),
            {"valid": np.ones((80, 79), np.uint8)},
            r"valid: required a uint8 mask of shape \(80, 80\)",
        ),
    ],
)
def test_wrong_input_is_refused_in_words(
    image: NDArray[np.uint8], options: dict[str, object], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        detect_markers(image, **options)  # type: ignore[arg-type]


def test_neighbours_on_a_square_grid_are_its_sides_not_its_diagonals() -> None:
    assert len(neighbour_graph(grid(5, 7, 20.0, corner=(0, 0), jitter=0.4), 60.0)) == 5 * 6 + 4 * 7


def test_neighbours_on_a_triangular_grid_are_all_six() -> None:
    centers = np.array([[10.0 * (column + row / 2), 8.66 * row] for row in range(5) for column in range(5)])
    degree = np.bincount(neighbour_graph(centers, 30.0).ravel(), minlength=25)
    assert degree[12] == 6


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_have_no_neighbours(count: int) -> None:
    assert neighbour_graph(np.zeros((count, 2)), 10.0).shape == (0, 2)


def test_a_fingervision_shows_its_dots_up_to_the_horizon_in_every_picture_at_rest(shared_data: Path) -> None:
    for name in ("000", "004", "009"):
        image = cv2.imread(str(shared_data / "fingervision_force" / f"{name}.jpg"))
        assert image is not None
        detection = detect_markers(np.asarray(image, np.uint8))
        # Of 35, all but the leftmost of the uppermost row; the window above it shows none.
        assert len(detection.centers) == 34
        assert detection.centers[:, 1].min() > 28


@pytest.mark.parametrize("name", ["wedge_roll/000.jpg", "wedge_ball/reference.jpg"])
def test_a_real_wedge_shows_its_140_dots(shared_data: Path, name: str) -> None:
    detection = detect_markers(rectified(shared_data / name))
    assert len(detection.centers) == 140
    # The known grid: 14 rows of 10, a pitch of about 20 px.
    assert detection.pitch == pytest.approx(20, abs=1)
    assert (np.diff(detection.centers.reshape(14, 10, 2)[..., 0], axis=1) > 15).all()


@pytest.mark.parametrize(
    ("name", "count", "polarity"),
    [
        # Counted by eye: the pins form a hexagon of 127; 90 big dots are whole; of some 88 to 96 square dots
        # the outermost are cut or torn; of the doubled marks those in the dark corners are hardly visible.
        ("other/tactip_bright_pins.png", (127, 127), "bright"),
        ("other/big_dots_a.png", (88, 92), "dark"),
        ("other/square_dots_reference.jpg", (85, 98), "dark"),
        ("gelslim_screw/reference.jpg", (225, 280), "dark"),
    ],
)
def test_other_real_gels_show_their_marks(
    shared_data: Path, name: str, count: tuple[int, int], polarity: str
) -> None:
    image = cv2.imread(str(shared_data / name))
    assert image is not None
    detection = detect_markers(np.asarray(image, np.uint8))
    assert count[0] <= len(detection.centers) <= count[1]
    assert detection.polarity == polarity


@pytest.mark.parametrize(
    ("name", "count", "polarity"),
    [
        # Counted by eye. Of sts_640, about 165 with those in the glare and below the glue; of
        # sts_torque160 about 150, the last columns 3 px apart; of wrs_cam1 the 92
        # that are whole; of handmade_dots about 121 whole ones, and dirt that cannot be told from small dots.
        ("sts_640/video.mp4", (150, 165), "bright"),
        ("sts_torque160/video.mp4", (143, 150), "bright"),
        ("handmade_dots/video.avi", (121, 127), "dark"),
        ("wrs_cam1/000.jpg", (90, 97), "dark"),
        ("tactip_video/000.png", (329, 333), "bright"),
        ("mini_ball/000.png", (63, 63), "dark"),
        ("gelslim_ball/000.jpg", (250, 253), "dark"),
        ("simple_marks/000.png", (140, 140), "dark"),
        ("handmade25/000.jpg", (25, 25), "dark"),
    ],
)
def test_gels_of_other_labs_show_their_marks(
    shared_data: Path, name: str, count: tuple[int, int], polarity: str
) -> None:
    detection = detect_markers(first_picture(shared_data / "gels" / name))
    assert count[0] <= len(detection.centers) <= count[1]
    assert detection.polarity == polarity


@pytest.mark.parametrize("name", ["thu_real", "mini_box", "digit_fots", "9dtact_1"])
def test_gels_of_other_labs_without_marks_are_recognised(shared_data: Path, name: str) -> None:
    with pytest.raises(NoMarkersError):
        detect_markers(first_picture(shared_data / "gels" / name / "000.png"))


def first_picture(path: Path) -> NDArray[np.uint8]:
    video = cv2.VideoCapture(str(path))
    _, image = video.read()
    video.release()
    assert image is not None
    return np.asarray(image, np.uint8)


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        *(("bolt_0", 0), ("foam_brick_2", 0), ("golf_ball_1", 0), ("rose_eraser_1", 0)),
        # Compression makes spots along the edge of the housing, half of whose parallelograms close.
        *(("foam_brick_2", 3), ("golf_ball_1", 21), ("purple_ball_hardest_3", 9), ("rose_eraser_1", 30)),
    ],
)
def test_a_real_gel_without_marks_is_recognised(shared_data: Path, name: str, frame: int) -> None:
    video = cv2.VideoCapture(str(shared_data / "wedge_grasp" / f"{name}.avi"))
    for _ in range(frame + 1):
        _, image = video.read()
    video.release()
    with pytest.raises(NoMarkersError):
        detect_markers(np.asarray(image, np.uint8))


def test_a_spot_that_does_not_look_like_the_marks_is_improbable() -> None:
    truth = grid(6, 8, 30.0, corner=(30, 30))
    image = render((270, 210), truth, 4.0, noise=1.0)
    # A smear in place of one of the dots.
    x, y = truth[19].astype(int)
    image[y - 9 : y + 10, x - 9 : x + 10] = image[5, 5]
    cv2.ellipse(image, (int(x), int(y)), (6, 4), 45, 0, 360, (90, 90, 90), cv2.FILLED)
    found = detect_markers(image, least_probability=0.0)
    assert found.probability is not None
    which, _ = match(found.centers, truth)
    assert (which == 19).sum() == 1
    assert found.probability[which == 19][0] < found.probability[which != 19].min()
    assert np.median(found.probability) > 0.99


def test_marks_that_are_less_probable_than_asked_for_are_left_out() -> None:
    image = render((270, 210), grid(6, 8, 30.0, corner=(30, 30)), 4.0, noise=1.0)
    found = detect_markers(image)
    assert found.probability is not None
    least = float(np.median(found.probability))
    assert len(detect_markers(image, least_probability=least).centers) < len(found.centers)


def test_a_mark_alone_has_no_probability() -> None:
    alone = detect_markers(render((100, 100), np.array([[50.0, 50.0]]), 5.0), dot_radius=5.0)
    assert alone.probability is not None
    assert np.isnan(alone.probability).all()


@pytest.mark.parametrize("dot_radius", [None, 3.5])
def test_dots_between_pixels_have_one_peak_each(dot_radius: float | None) -> None:
    """Each is as high at two or four pixels."""
    rows, columns = np.mgrid[:120, :140]
    away = np.hypot((columns - 20.5) % 20 - 10, (rows - 20.5) % 20 - 10)
    picture = np.asarray(180 - 120 * np.clip(4 - away, 0, 1), np.uint8)
    detection = detect_markers(picture, dot_radius=dot_radius)
    assert detection.pitch == pytest.approx(20)
    assert len(np.unique(np.rint(detection.centers), axis=0)) == len(detection.centers) >= 24


def test_one_square_is_no_grid_of_marks() -> None:
    picture = np.full((200, 200), 180, np.uint8)
    picture[100:104, 100:104] = 60
    with pytest.raises(NoMarkersError):
        detect_markers(picture)


def test_marks_that_are_never_probable_enough_are_none() -> None:
    picture = open_scene("press").frame(0)
    with pytest.raises(NoMarkersError):
        detect_markers(picture, least_probability=1.0)
