"""Opening a source by what the user typed."""

from __future__ import annotations

import logging
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.errors import SourceError
from tactflow.sources import FrameReader, base, open_source

Pixels = NDArray[np.uint8]


def numbered(index: int, height: int = 24, width: int = 32) -> Pixels:
    """A frame whose every pixel tells its index."""
    return np.full((height, width, 3), 10 * (index + 1), np.uint8)


def write_video(path: Path, count: int = 5, codec: str = "HFYU", fps: float = 20.0) -> None:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), fps, (32, 24))
    for index in range(count):
        writer.write(numbered(index))
    writer.release()


def make_folder(path: Path) -> str:
    path.mkdir()
    for index in range(5):
        cv2.imwrite(str(path / f"cal-{index * 5}.png"), numbered(index))
    return str(path)


def make_glob(path: Path) -> str:
    make_folder(path)
    (path / "notes.txt").write_text("not a frame")
    return str(path / "cal-*.png")


def make_bgr_array(path: Path) -> str:
    np.save(path.with_suffix(".npy"), np.stack([numbered(i) for i in range(5)]))
    return str(path.with_suffix(".npy"))


def make_gray_array(path: Path) -> str:
    np.save(path.with_suffix(".npy"), np.stack([numbered(i)[..., 0] for i in range(5)]))
    return str(path.with_suffix(".npy"))


def make_fortran_array(path: Path) -> str:
    np.save(path.with_suffix(".npy"), np.asfortranarray(np.stack([numbered(i) for i in range(5)])))
    return str(path.with_suffix(".npy"))


def make_video(path: Path) -> str:
    write_video(path.with_suffix(".avi"))
    return str(path.with_suffix(".avi"))


KINDS: list[Callable[[Path], str]] = [
    make_folder,
    make_glob,
    make_bgr_array,
    make_gray_array,
    make_fortran_array,
    make_video,
]


def read_all(source: FrameReader) -> list[tuple[Pixels, float]]:
    frames = []
    while (item := source.read()) is not None:
        frames.append(item)
    source.close()
    return frames


@pytest.mark.parametrize("make", KINDS)
def test_every_kind_of_recording_gives_its_frames_in_order(
    make: Callable[[Path], str], tmp_path: Path
) -> None:
    source = open_source(make(tmp_path / "recording"))

    assert not source.live
    assert source.total == 5
    assert source.size == (32, 24)
    frames = read_all(source)
    for index, (image, _) in enumerate(frames):
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, numbered(index))
    assert len(frames) == 5
    assert source.read() is None


@pytest.mark.parametrize("make", KINDS)
def test_every_kind_of_recording_can_be_closed_early_and_twice(
    make: Callable[[Path], str], tmp_path: Path
) -> None:
    source = open_source(make(tmp_path / "recording"))
    source.read()
    source.close()
    source.close()
    assert source.read() is None


@pytest.mark.parametrize("make", [make_folder, make_glob, make_bgr_array])
def test_images_and_arrays_are_timed_by_fps(make: Callable[[Path], str], tmp_path: Path) -> None:
    spec = make(tmp_path / "recording")
    # Each time is one division, so equality is exact.
    assert [t for _, t in read_all(open_source(spec))] == [index / 30.0 for index in range(5)]
    assert [t for _, t in read_all(open_source(spec, fps=8.0))] == [index / 8.0 for index in range(5)]


def test_a_video_is_timed_by_its_own_stamps(tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", fps=20.0)
    source = open_source(str(tmp_path / "v.avi"), fps=8.0)
    assert source.fps == 20.0
    # 1e-6 s: the stamps come in milliseconds as doubles; their rounding is far below.
    np.testing.assert_allclose([t for _, t in read_all(source)], np.arange(5) / 20.0, atol=1e-6)


def test_the_real_video_has_increasing_times(shared_data: Path) -> None:
    frames = read_all(open_source(str(shared_data / "wedge_grasp" / "bolt_0.avi")))
    times = [t for _, t in frames]
    assert len(frames) == 70
    assert times[0] == 0.0
    # 1e-6 s: see above; the file has 30 frames a second.
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=1e-6)


def test_the_real_folder_has_all_its_frames(shared_data: Path) -> None:
    source = open_source(str(shared_data / "wedge_roll"))
    assert source.total == 301
    assert source.size == (240, 320)


def test_one_image_is_a_recording_of_one_frame(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), numbered(3))
    [(image, t)] = read_all(open_source(str(tmp_path / "a.png")))
    np.testing.assert_array_equal(image, numbered(3))
    assert t == 0.0


def test_numbers_in_names_are_sorted_by_value_and_hidden_files_are_left_out(tmp_path: Path) -> None:
    for name, index in [("cal-10.png", 2), ("cal-2.png", 1), ("Cal-1.png", 0), ("cal-100.png", 3)]:
        cv2.imwrite(str(tmp_path / name), numbered(index))
    (tmp_path / "._cal-3.png").write_bytes(b"not an image")
    (tmp_path / "labels.csv").write_text("frame,force")
    frames = read_all(open_source(str(tmp_path)))
    assert [int(image[0, 0, 0]) for image, _ in frames] == [10, 20, 30, 40]


@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_that_is_cut_during_the_run_is_an_error(order: Literal["C", "F"], tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.asarray(np.stack([numbered(index) for index in range(5)]), order=order))
    source = open_source(str(path))
    assert source.read() is not None
    os.truncate(path, 4000)
    with pytest.raises(SourceError, match="was cut off during the run, within frame 1"):
        source.read()
    source.close()


def test_an_array_larger_than_memory_opens_at_once(tmp_path: Path) -> None:
    path = tmp_path / "huge.npy"
    # A sparse file: 1.4 TB of promised frames, of which the disk holds only the header.
    shape = (1_000_000, 600, 800, 3)
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
        try:
            file.truncate(file.tell() + int(np.prod(shape)))
        except OSError:
            pytest.skip("this file system has no files of 1.4 TB")
    source = open_source(str(path))
    item = source.read()
    source.close()
    path.unlink()
    assert source.total == 1_000_000
    assert item is not None
    assert item[0].shape == (600, 800, 3)


@pytest.mark.parametrize(
    ("pixels", "expected", "note"),
    [
        (np.full((4, 6), 77, np.uint8), 77, "gray"),
        (np.full((4, 6, 4), 77, np.uint8), 77, "alpha"),
        (np.full((4, 6, 3), 77 * 257, np.uint16), 77, "16-bit"),
        (np.full((4, 6), 77 * 257, np.uint16), 77, "16-bit"),
        (np.full((4, 6, 4), 65535, np.uint16), 255, "16-bit"),
    ],
)
def test_other_kinds_of_pixels_are_converted_with_one_note(
    pixels: NDArray[np.uint8], expected: int, note: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for index in range(3):
        cv2.imwrite(str(tmp_path / f"{index}.png"), pixels)
    with caplog.at_level(logging.INFO, "tactflow"):
        frames = read_all(open_source(str(tmp_path)))
    for image, _ in frames:
        np.testing.assert_array_equal(image, np.full((4, 6, 3), expected, np.uint8))
    assert sum(note in record.message for record in caplog.records) == 1


def test_16_bit_pixels_are_read_in_either_order_of_their_bytes(tmp_path: Path) -> None:
    levels = np.arange(4 * 6).reshape(4, 6)
    np.save(tmp_path / "a.npy", (257 * levels[None]).astype(">u2"))
    ((image, _),) = read_all(open_source(str(tmp_path / "a.npy")))
    np.testing.assert_array_equal(image[..., 0], levels)


def test_few_bits_in_a_16_bit_file_are_pointed_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), np.full((4, 6), 4000, np.uint16))
    with caplog.at_level(logging.WARNING, "tactflow"):
        read_all(open_source(str(tmp_path)))
    assert "12 bits" in caplog.text
    assert "multiply the values by 16" in caplog.text


@pytest.mark.parametrize("pages", [1, 5])
def test_pictures_behind_the_first_of_a_file_are_pointed_out(
    pages: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "stack.tiff"
    cv2.imwritemulti(str(path), [np.full((48, 64, 3), page, np.uint8) for page in range(pages)])
    reader = open_source(str(path))
    assert reader.total == 1
    told = f"{path}: holds {pages} pictures, of which only the first is read" in caplog.text
    assert told == (pages > 1)


def test_a_relative_path_is_looked_for_here_first_and_then_beside_the_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, beside = tmp_path / "here", tmp_path / "beside"
    for folder, level in ((here, 1), (beside, 2)):
        folder.mkdir()
        cv2.imwrite(str(folder / "both.png"), np.full((4, 6, 3), level, np.uint8))
    cv2.imwrite(str(beside / "only.png"), np.full((4, 6, 3), 3, np.uint8))
    monkeypatch.chdir(here)

    def level(spec: str) -> int:
        item = open_source(spec, directory=beside).read()
        assert item is not None
        return int(item[0][0, 0, 0])

    assert level("both.png") == 1
    assert level("only.png") == 3
    assert level("on*.png") == 3


def test_a_video_that_was_cut_off_gives_what_it_has_and_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "v.avi"
    rng = np.random.default_rng(0)
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    for _ in range(30):
        writer.write(rng.integers(0, 256, (48, 64, 3), np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with caplog.at_level(logging.WARNING, "tactflow"):
        frames = read_all(open_source(str(path)))
    assert 5 < len(frames) < 25
    assert f"ended after {len(frames)} of 30 frames" in caplog.text


def test_a_video_with_larger_pictures_than_a_camera_has_is_refused_before_they_are_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    monkeypatch.setattr(base, "MOST_PIXELS", 3000)
    with pytest.raises(SourceError, match=r"64 x 48, more than 3000 pixels"):
        open_source(str(path))


# -- what cannot be opened ---------------------------------------------------------------------------------


def _bad_array(array: NDArray[np.generic]) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        np.save(folder / "a.npy", array)
        return str(folder / "a.npy")

    return make


def _bytes(name: str, data: bytes) -> Callable[[Path], str]:
    def make(folder: Path) -> str:
        (folder / name).write_bytes(data)
        return str(folder / name)

    return make


def _near_name(folder: Path) -> str:
    (folder / "wedge_roll.avi").write_bytes(b"x")
    return str(folder / "wedge_rol.avi")


def _near_folder(folder: Path) -> str:
    (folder / "recordings").mkdir()
    return str(folder / "recordigns" / "a.avi")


def _empty_folder(folder: Path) -> str:
    return str(folder)


def _folder_of_folders(folder: Path) -> str:
    (folder / "monday").mkdir()
    return str(folder)


def _folder_of_text(folder: Path) -> str:
    (folder / "notes.txt").write_text("x")
    return str(folder)


def _truncated_array(folder: Path) -> str:
    path = folder / "a.npy"
    np.save(path, np.zeros((4, 5, 6, 3), np.uint8))
    path.write_bytes(path.read_bytes()[:-10])
    return str(path)


def _pickled_array(folder: Path) -> str:
    np.save(folder / "a.npy", np.array([{}], object), allow_pickle=True)
    return str(folder / "a.npy")


def _archive(folder: Path) -> str:
    np.savez(folder / "a.npz", a=np.zeros(3))
    return str(folder / "a.npz")


def _fixed(spec: str) -> Callable[[Path], str]:
    return lambda folder: spec.replace("FOLDER", str(folder))


BAD = {
    "near name": (_near_name, ["no such file", "did you mean", "wedge_roll.avi"]),
    "near folder": (_near_folder, ["no such file", "did you mean", "recordings"]),
    "nothing near": (_fixed("FOLDER/a.avi"), ["no such file", "looked in"]),
    "empty folder": (_empty_folder, ["no images", "empty"]),
    "folder of folders": (_folder_of_folders, ["no images", "monday/", "name one of its folders"]),
    "folder of text": (_folder_of_text, ["no images", "notes.txt"]),
    "glob": (_fixed("FOLDER/*.png"), ["no file matches", "quote"]),
    "array of floats": (_bad_array(np.zeros((2, 4, 5, 3))), ["uint8", "float64", "2 x 4 x 5 x 3"]),
    "array with 1 axis": (_bad_array(np.zeros(7, np.uint8)), ["N x H x W", "shape 7"]),
    "array with 0 axes": (_bad_array(np.array(7, np.uint8)), ["N x H x W", "shape ()"]),
    "array with 2 channels": (_bad_array(np.zeros((2, 4, 5, 2), np.uint8)), ["2 x 4 x 5 x 2"]),
    "array of one image": (_bad_array(np.zeros((4, 5, 3), np.uint8)), ["single image", "array[None]"]),
    "array without frames": (_bad_array(np.zeros((0, 4, 5, 3), np.uint8)), ["0 x 4 x 5 x 3"]),
    "truncated array": (_truncated_array, ["cut off"]),
    "empty array file": (_bytes("a.npy", b""), ["not a .npy"]),
    "text as array": (_bytes("a.npy", b"hello world, this is no array"), ["not a .npy"]),
    "pickled array": (_pickled_array, ["not a .npy"]),
    "damaged header": (
        _bytes("a.npy", b"\x93NUMPY\x01\x00" + bytes(200)),
        ["not a .npy", "or a damaged one"],
    ),
    "header that is not Python": (
        _bytes("a.npy", b"\x93NUMPY\x01\x00\x76\x00" + b"{'shape': (1, \n".ljust(118)),
        ["not a .npy", "or a damaged one"],
    ),
    "archive of arrays": (_archive, [".npz", "np.save"]),
    "text as image": (_bytes("a.png", b"hello"), ["not an image"]),
    "PNG with a piece of 2 GB": (
        _bytes("a.png", b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + bytes(17) + b"\x7f\xff\xff\xffIDATIEND"),
        ["cut off"],
    ),
    "empty image": (_bytes("a.png", b""), ["empty"]),
    "list of videos": (_bytes("a.avi", b"ffconcat version 1.0\nfile b.avi\n"), ["list of other files"]),
    "playlist": (_bytes("a.m3u8", b"\xef\xbb\xbf#EXTM3U\n/b.ts\n"), ["list of other files"]),
    "text as video": (_bytes("a.avi", b"hello"), ["neither a video"]),
    "empty video": (_bytes("a.mp4", b""), ["empty"]),
    "no kind at all": (_bytes("a.xyz", b"hello"), ["neither a video"]),
    "unknown scheme": (_fixed("ftp://host/a.avi"), ["unknown kind", "ftp://", "rtsp://"]),
    "file scheme": (_fixed("file:///a.avi"), ["leave out file://"]),
    "nothing": (_fixed("  "), ["empty", "sim:NAME"]),
    "unknown scene": (_fixed("sim:pres"), ["sim:pres", "did you mean press"]),
    "unknown scene's key": (_fixed("sim:press?frame=3"), ["did you mean frames"]),
}


@pytest.mark.parametrize(("make", "expected"), BAD.values(), ids=BAD.keys())
def test_what_cannot_be_opened_is_a_source_error_that_says_what_to_try(
    make: Callable[[Path], str], expected: list[str], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SourceError) as raised:
        open_source(make(tmp_path))
    for words in expected:
        assert words in str(raised.value)
    assert raised.value.exit_code == 4
    assert capfd.readouterr().err == "", "OpenCV's own messages must not mix with ours"


def _png(level: int = 5, size: tuple[int, int] = (24, 32)) -> bytes:
    return bytes(cv2.imencode(".png", np.full((*size, 3), level, np.uint8))[1])


def _jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8))[1])


@pytest.mark.parametrize(
    ("name", "data", "expected"),
    [
        ("2.png", b"not an image", "not an image"),
        ("2.png", _png()[:-20], "cut off"),
        ("2.jpg", _jpeg()[: len(_jpeg()) // 2], "cut off"),
        ("2.jpg", b"", "empty"),
        ("2.png", _png(size=(24, 30)), "30 x 24 pixels, the ones before it are 32 x 24"),
    ],
    ids=["garbage", "half a png", "half a jpg", "nothing", "another size"],
)
def test_a_bad_image_in_the_middle_of_a_folder_is_an_error_that_names_it(
    name: str, data: bytes, expected: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for index in (0, 1, 3):
        (tmp_path / f"{index}.png").write_bytes(_png())
    (tmp_path / name).write_bytes(data)
    source = open_source(str(tmp_path))
    assert source.read() is not None
    assert source.read() is not None
    with pytest.raises(SourceError, match=expected) as raised:
        source.read()
    assert str(tmp_path / name) in str(raised.value)
    assert capfd.readouterr().err == ""


def test_an_image_with_a_thumbnail_and_something_behind_its_end_is_whole(tmp_path: Path) -> None:
    jpeg = _jpeg()
    # A thumbnail sits in an application segment behind the start of the image.
    thumbnail = b"Exif\0\0" + jpeg
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    with_thumbnail = jpeg[:2] + segment + jpeg[2:]
    (tmp_path / "0.jpg").write_bytes(with_thumbnail + b"camera's own data" * 1000)
    assert len(read_all(open_source(str(tmp_path)))) == 1
    (tmp_path / "0.jpg").write_bytes(with_thumbnail[:-100])
    with pytest.raises(SourceError, match="cut off"):
        open_source(str(tmp_path))


def test_a_simulated_scene_is_a_recording() -> None:
    source = open_source("sim:press?frames=3&seed=1")
    assert (source.live, source.total, source.size, source.fps) == (False, 3, (800, 600), 60.0)
    frames = read_all(source)
    assert [t for _, t in frames] == [0.0, 1 / 60, 2 / 60]
    assert all(image.shape == (600, 800, 3) for image, _ in frames)


def test_a_file_that_claims_an_absurd_picture_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    sparse = tmp_path / "sparse.npy"
    np.lib.format.open_memmap(sparse, "w+", np.uint8, (1, 40000, 40000, 3))
    with pytest.raises(SourceError, match="40000 x 40000, more than"):
        open_source(str(sparse))
    picture = tmp_path / "picture.png"
    # A picture of black that says that it is larger: nothing but its header is looked at.
    data = bytearray(cv2.imencode(".png", np.zeros((20, 20), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", 40000, 40000)
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    picture.write_bytes(data)
    with pytest.raises(SourceError, match=r"has more than|not an image"):
        open_source(str(picture))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such device")
def test_a_link_to_a_device_is_no_picture(tmp_path: Path) -> None:
    link = tmp_path / "a.png"
    link.symlink_to("/dev/zero")
    with pytest.raises(SourceError, match="is a pipe or a device, not a file"):
        open_source(str(link))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such files")
@pytest.mark.parametrize("name", ["a.mcap", "a.mcap?start=2", "a.npy", "a.avi", "a.png", "a.h5?dataset=/a"])
def test_nobody_waits_for_who_may_write_to_a_pipe(name: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / name.partition("?")[0])
    with pytest.raises(SourceError, match="is a pipe or a device, not a file"):
        open_source(str(tmp_path / name))


def test_a_pattern_for_all_folders_follows_no_links_in_circles(tmp_path: Path) -> None:
    make_folder(tmp_path / "pictures")
    for name in ("one", "two"):
        (tmp_path / "pictures" / name).symlink_to(tmp_path / "pictures", target_is_directory=True)
    assert len(read_all(open_source(str(tmp_path / "**" / "*.png")))) == 5
