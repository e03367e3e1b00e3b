"""Videos that OpenCV cannot decode, that have no steady rate, or that end too early."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.cli.main import main
from tactflow.engine.errors import SourceError
from tactflow.sources import open_source
from tactflow.sources.video import PyAvVideo, VideoFile

av = pytest.importorskip("av", reason="the extra video is not installed")

LEVELS = np.arange(20, 220, 10, np.uint8)
EVEN = [40 * index for index in range(20)]
UNEVEN = [*range(0, 400, 20), *range(400, 2400, 100)]


def write_film(path: Path, codec: str, stamps: Sequence[int], levels: NDArray[np.uint8] = LEVELS) -> Path:
    """Gray pictures of these levels, over and over. stamps : of the frames, ms."""
    with av.open(str(path), "w") as file:
        options = {"preset": "10"} if codec == "libsvtav1" else {}
        stream = file.add_stream(codec, rate=25, options=options)
        stream.width, stream.height = 96, 64
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for index, stamp in enumerate(stamps):
            picture = np.full((64, 96, 3), levels[index % len(levels)], np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            frame.pts, frame.time_base = stamp, Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    if codec == "libsvtav1" and sys.platform == "linux":
        # Where the user is root, this encoder makes the calling thread a real-time one.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return path


@pytest.mark.parametrize("name", ["press.mp4", "press.mkv", "press.webm"])
def test_an_av1_video_is_read_through_pyav(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_film(tmp_path / name, "libsvtav1", EVEN)
    capfd.readouterr()
    source = open_source(str(path))
    assert (source.size, source.total, source.live) == ((96, 64), 20, False)
    found = list(iter(source.read, None))
    source.close()
    assert source.read() is None
    np.testing.assert_allclose([image.mean() for image, _ in found], LEVELS, atol=4)
    np.testing.assert_allclose([t for _, t in found], np.arange(20) / 25, atol=1e-3)
    assert capfd.readouterr().err == "", "messages of the decoders must not mix with ours"
    assert not caplog.records


def test_without_pyav_the_codec_is_named_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_film(tmp_path / "press.mp4", "libsvtav1", EVEN)
    monkeypatch.setitem(sys.modules, "av", None)
    assert main(["run", "markerless", "--source", str(path), "--set", "sinks={}"]) == 4
    said = capsys.readouterr().err
    assert "AV1 videos need av: pip install 'tactflow[video]'; or convert it: ffmpeg -i press.mp4" in said


def test_a_video_that_neither_can_decode_is_called_damaged(tmp_path: Path) -> None:
    path = write_film(tmp_path / "press.mp4", "libsvtav1", EVEN)
    data = bytearray(path.read_bytes())
    begin = data.index(b"mdat") + 4
    data[begin : data.index(b"moov") - 4] = bytes(data.index(b"moov") - 4 - begin)
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"\(AV01\) holds no frame that can be decoded; is it damaged"):
        open_source(str(path))


FILMS = {
    "even.mkv": EVEN,
    "uneven.mkv": UNEVEN,
    "uneven.mp4": UNEVEN,
    "every other frame late.mkv": [40 * index + 15 * (index % 2) for index in range(20)],
    "begun late.mkv": [5000 + stamp for stamp in EVEN],
}


@pytest.mark.parametrize("reader", [VideoFile, PyAvVideo])
@pytest.mark.parametrize("name", FILMS)
def test_a_complete_video_ends_without_a_warning_and_a_cut_one_with_it(
    name: str, reader: type[VideoFile | PyAvVideo], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps = FILMS[name]
    path = write_film(tmp_path / name, "mjpeg", stamps)

    def times() -> list[float]:
        with caplog.at_level(logging.WARNING, "tactflow"):
            source = reader(path)
            found = [t for _, t in iter(source.read, None)]
            source.close()
        lacking.append(source.lacking)
        return found

    lacking: list[int] = []
    np.testing.assert_allclose(times(), np.subtract(stamps, stamps[0]) / 1000, atol=1e-3)
    assert not caplog.records
    if name.endswith(".mkv"):
        # An .mp4 keeps its index at the end.
        os.truncate(path, path.stat().st_size * 7 // 10)
        count = len(times())
        assert 8 < count < len(stamps)
        assert lacking[0] == 0 < lacking[1]
        (record,) = caplog.records
        assert f"ended after {count} frames, " in record.message
        assert "before its stated end; the file may be damaged" in record.message


def test_a_lost_last_frame_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write_film(tmp_path / "press.mkv", "mjpeg", EVEN)
    # The last picture, of a level that no other one has, ends the last cluster.
    os.truncate(path, path.read_bytes().rindex(b"\xff\xd8\xff"))
    source = open_source(str(path))
    with caplog.at_level(logging.WARNING, "tactflow"):
        assert len(list(iter(source.read, None))) == 19
    assert source.lacking == 1
    assert "ended after 19 frames, 0.08 s before its stated end" in caplog.text
