"""Opening a source by what the user typed."""

from __future__ import annotations

import io
import logging
import os
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.cli.main import main
from tactflow.engine.errors import SourceError
from tactflow.sources import FrameReader, base, open_source

Pixels = NDArray[np.uint8]
FRAMES = np.stack([np.full((24, 32, 3), 10 * (index + 1), np.uint8) for index in range(5)])
"""Frames whose every pixel tells their index."""


def write_video(path: Path, frames: NDArray[np.uint8], codec: str = "HFYU") -> None:
    size = (frames.shape[2], frames.shape[1])
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*codec), 20.0, size)
    for frame in frames:
        writer.write(frame)
    writer.release()


def encoded(image: NDArray[Any], suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def make(folder: Path, kind: str) -> str:
    """A recording of `FRAMES`; what to open."""
    path = folder / kind
    if kind.endswith(".avi"):
        write_video(path, FRAMES)
    elif kind.endswith(".npy"):
        frames = FRAMES[..., 0] if kind == "gray.npy" else FRAMES
        np.save(path, np.asfortranarray(frames) if kind == "fortran.npy" else frames)
    else:
        folder = path if kind == "folder" else path.parent
        folder.mkdir(exist_ok=True)
        for index, frame in enumerate(FRAMES):
            (folder / f"cal-{5 * index}.png").write_bytes(encoded(frame))
        (folder / "notes.txt").write_text("not a frame")
    return str(path)


def read_all(source: FrameReader) -> list[tuple[Pixels, float]]:
    frames = list(iter(source.read, None))
    source.close()
    return frames


KINDS = ["folder", "cal-*.png", "bgr.npy", "gray.npy", "fortran.npy", "video.avi"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_recording_gives_its_frames_in_order_and_can_be_closed_early_and_twice(
    kind: str, tmp_path: Path
) -> None:
    spec = make(tmp_path, kind)
    source = open_source(spec)
    assert (source.live, source.total, source.size) == (False, 5, (32, 24))
    frames = read_all(source)
    assert source.read() is None
    np.testing.assert_array_equal([image for image, _ in frames], FRAMES)
    # A video has its own stamps, in milliseconds: 1e-6 s is far above their rounding.
    rate = 20.0 if kind == "video.avi" else 30.0
    np.testing.assert_allclose([t for _, t in frames], np.arange(5) / rate, atol=1e-6)
    source = open_source(spec, fps=8.0)
    assert source.fps == (20.0 if kind == "video.avi" else 8.0)
    source.read()
    source.close()
    source.close()
    assert source.read() is None


def test_numbers_in_names_are_sorted_by_value_and_hidden_files_are_left_out(tmp_path: Path) -> None:
    for index, name in enumerate(["Cal-1.png", "cal-2.png", "cal-10.png", "cal-100.png"]):
        (tmp_path / name).write_bytes(encoded(FRAMES[index]))
    (tmp_path / "._cal-3.png").write_bytes(b"not an image")
    np.testing.assert_array_equal([image for image, _ in read_all(open_source(str(tmp_path)))], FRAMES[:4])
    [(image, t)] = read_all(open_source(str(tmp_path / "cal-2.png")))
    assert (image[0, 0, 0], t) == (20, 0.0)


@pytest.mark.parametrize(
    ("pixels", "expected", "note"),
    [
        (np.full((4, 6), 77, np.uint8), 77, ""),
        (np.full((4, 6, 4), 77, np.uint8), 77, "alpha"),
        (np.full((4, 6, 3), 77 * 257, np.uint16), 77, "16-bit"),
        (np.full((4, 6, 4), 65535, np.uint16), 255, "16-bit"),
    ],
)
def test_other_kinds_of_pixels_are_converted_with_one_note(
    pixels: NDArray[np.uint8], expected: int, note: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for index in range(3):
        (tmp_path / f"{index}.png").write_bytes(encoded(pixels))
    with caplog.at_level(logging.INFO, "tactflow"):
        for image, _ in read_all(open_source(str(tmp_path))):
            np.testing.assert_array_equal(image, np.full((4, 6, 3), expected, np.uint8))
    assert sum(note in record.message for record in caplog.records) == bool(note)


def test_16_bit_arrays_have_either_order_of_bytes_and_few_bits_are_pointed_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    np.save(tmp_path / "a.npy", FRAMES.astype(">u2") * 16)
    read_all(open_source(str(tmp_path / "a.npy")))
    assert "no value above 160: a sensor with fewer bits?" in caplog.text
    np.save(tmp_path / "a.npy", FRAMES.astype(">u2") * 257)
    found = read_all(open_source(str(tmp_path / "a.npy")))
    np.testing.assert_array_equal([image for image, _ in found], FRAMES)


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (
            [(24, 32), (24, 32), (20, 32)],
            "cal-2.png: this frame is 32 x 20 pixels, the ones before it are 32 x 24",
        ),
        ([(1, 1)], "cal-0.png: its pictures are 1 x 1; required 2 x 2 pixels or more"),
    ],
)
def test_a_picture_of_a_wrong_size_ends_the_run_and_is_named(
    shapes: list[tuple[int, int]], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for index, shape in enumerate(shapes):
        (tmp_path / f"cal-{index}.png").write_bytes(encoded(np.full((*shape, 3), 90, np.uint8)))
    assert main(["run", "markerless", "--source", str(tmp_path), "--set", "sinks={}"]) == 4
    assert message in capsys.readouterr().err


def test_a_relative_path_is_looked_for_here_first_and_then_beside_the_pipeline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, beside = tmp_path / "here", tmp_path / "beside"
    for path, index in ((here / "both.png", 0), (beside / "both.png", 1), (beside / "only.png", 2)):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(encoded(FRAMES[index]))
    monkeypatch.chdir(here)
    for spec, index in (("both.png", 0), ("only.png", 2), ("on*.png", 2)):
        [(image, _)] = read_all(open_source(spec, directory=beside))
        np.testing.assert_array_equal(image, FRAMES[index])


# -- what cannot be opened ---------------------------------------------------------------------------------


def npy(array: NDArray[Any], save: Callable[..., None] = np.save) -> bytes:
    file = io.BytesIO()
    save(file, array)
    return file.getvalue()


JPEG = encoded(np.random.default_rng(0).integers(0, 256, (24, 32, 3), np.uint8), ".jpg")
HUGE_PIECE = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(17) + b"\x7f\xff\xff\xffIDATIEND"
NOT_PYTHON = b"\x93NUMPY\x01\x00\x76\x00" + b"{'shape': (1, \n".ljust(118)
BAD_FILES: dict[str, tuple[str, bytes, str]] = {
    "floats": ("a.npy", npy(np.zeros((2, 4, 5, 3))), "uint8 .*float64 of shape 2 x 4 x 5 x 3"),
    "0 axes": ("a.npy", npy(np.array(7, np.uint8)), r"N x H x W.* of shape \(\)"),
    "2 channels": ("a.npy", npy(np.zeros((2, 4, 5, 2), np.uint8)), "2 x 4 x 5 x 2"),
    "one image": ("a.npy", npy(np.zeros((4, 5, 3), np.uint8)), r"a single picture\? Give array\[None\]"),
    "no frames": ("a.npy", npy(np.zeros((0, 4, 5, 3), np.uint8)), "0 x 4 x 5 x 3"),
    "cut array": ("a.npy", npy(FRAMES)[:-10], "is cut off"),
    "archive": ("a.npz", npy(FRAMES, np.savez), r"a \.npz archive; save its array with np\.save"),
    "empty array": ("a.npy", b"", "not a .npy"),
    "pickled array": ("a.npy", npy(np.array([{}], object)), "not a .npy"),
    "damaged header": ("a.npy", b"\x93NUMPY\x01\x00" + bytes(200), "not a .npy file, or a damaged one"),
    "header that is not Python": ("a.npy", NOT_PYTHON, "not a .npy file, or a damaged one"),
    "text as image": ("a.png", b"hello", "not an image"),
    "PNG with a piece of 2 GB": ("a.png", HUGE_PIECE, "cut off"),
    "half a JPEG": ("a.jpg", JPEG[: len(JPEG) // 2], "cut off"),
    "half a PNG": ("a.png", encoded(FRAMES[0])[:-20], "cut off"),
    "empty image": ("a.png", b"", "empty"),
    "playlist": ("a.m3u8", b"\xef\xbb\xbf#EXTM3U\n/b.ts\n", "list of other files"),
    "text as video": ("a.avi", b"hello", "neither a video"),
    "empty video": ("a.mp4", b"", "empty"),
    "no kind at all": ("a.xyz", b"hello", "neither a video"),
    "folder of text": ("inside/notes.txt", b"hello", r"no images in this folder; it holds notes\.txt"),
    "folder of folders": ("inside/monday/a.png", b"", "it holds monday/; name one of its folders"),
}
BAD_NAMES = {
    "recordigns/a.avi": "no such file.* did you mean .*recordings",
    "recordings/press.av": r"no such file.* did you mean .*press\.avi",
    "a/b.xyz": "no such file .*looked in",
    "*.png": "no file matches.* quote",
    "empty": "no images in this folder; it is empty",
    "ftp://host/a.avi": "unknown kind of source ftp://; required one of.*rtsp://",
    "file:///a.avi": "leave out file://",
    "  ": "source is empty; .*sim:NAME",
    "sim:pres": "sim:pres.*did you mean press",
    "sim:press?frame=3": "did you mean frames",
}


def refuse(spec: str, says: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SourceError, match=says) as raised:
        open_source(spec)
    assert raised.value.exit_code == 4
    assert capfd.readouterr().err == "", "OpenCV's own messages must not mix with ours"


@pytest.mark.parametrize(("name", "data", "says"), BAD_FILES.values(), ids=BAD_FILES.keys())
def test_a_file_that_is_no_recording_is_an_error_that_says_what_to_try(
    name: str, data: bytes, says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    refuse(str(tmp_path / name.partition("/")[0]), says, capfd)


@pytest.mark.parametrize("name", BAD_NAMES)
def test_a_name_of_nothing_is_an_error_that_says_what_to_try(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("empty", "recordings"):
        Path(folder).mkdir()
    Path("recordings/press.avi").touch()
    refuse(name, BAD_NAMES[name], capfd)


def test_an_image_with_a_thumbnail_and_something_behind_its_end_is_whole(tmp_path: Path) -> None:
    # A thumbnail sits in an application segment behind the start of the image.
    thumbnail = b"Exif\0\0" + JPEG
    segment = b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail
    with_thumbnail = JPEG[:2] + segment + JPEG[2:]
    (tmp_path / "0.jpg").write_bytes(with_thumbnail + b"camera's own data" * 1000)
    assert len(read_all(open_source(str(tmp_path)))) == 1
    (tmp_path / "0.jpg").write_bytes(with_thumbnail[:-100])
    with pytest.raises(SourceError, match="cut off"):
        open_source(str(tmp_path))


def test_a_file_that_claims_an_absurd_picture_is_refused_before_memory_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sparse = tmp_path / "sparse.npy"
    np.lib.format.open_memmap(sparse, "w+", np.uint8, (1, 40000, 40000, 3))
    with pytest.raises(SourceError, match="40000 x 40000, more than"):
        open_source(str(sparse))
    picture = tmp_path / "picture.png"
    # A picture of black that says that it is larger: nothing but its header is looked at.
    data = bytearray(encoded(np.zeros((20, 20), np.uint8)))
    data[16:24] = struct.pack(">II", 40000, 40000)
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    picture.write_bytes(data)
    with pytest.raises(SourceError, match=r"has more than|not an image"):
        open_source(str(picture))
    monkeypatch.setattr(base, "MAX_PIXELS", 700)
    with pytest.raises(SourceError, match="32 x 24, more than 700 pixels"):
        open_source(make(tmp_path, "video.avi"))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such files")
def test_nobody_reads_a_device_or_waits_for_who_may_write_to_a_pipe(tmp_path: Path) -> None:
    (tmp_path / "device.png").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "pipe")
    specs = ["device.png"]
    for name in ("a.mcap", "a.npy", "a.avi", "a.png", "a.h5"):
        (tmp_path / name).symlink_to("pipe")
        specs += [name, f"{name}?start=2"] if name == "a.mcap" else [name]
    for spec in [*specs, "a.h5?dataset=/a"]:
        with pytest.raises(SourceError, match="is a pipe or a device, not a file"):
            open_source(str(tmp_path / spec))
