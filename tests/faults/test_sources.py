"""Faults of sources: gone, cut, corrupt, of another size, frozen."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.engine.run import Runner
from tactflow.sources import Watch, Watched
from tactflow.stages.capture import Capture
from tests.faults.rig import FAULT_AT, FRAMES, Seen, array, run
from tests.sources.flaky import Flaky
from tests.sources.test_watch import QUICK

LONG = 2000
"""Frames of a recording from which a run takes only some, so that much of it is still unread at the fault."""


class Scripted(Capture):
    """A camera that follows a script."""

    device = Flaky()

    def __init__(self, params: Any) -> None:
        def opener(*_: object, watch: Watch, **__: object) -> Watched:
            times = {**QUICK, "no_frame_timeout": watch.no_frame_timeout, "reconnect": watch.reconnect}
            return Watched(self.device.open, Watch(**times), "flaky", self.device.clock)  # type: ignore[arg-type]

        super().__init__(params, opener=opener)


def make_pictures(folder: Path) -> Path:
    """A recording as a folder of pictures."""
    pictures = folder / "pictures"
    pictures.mkdir()
    for number, picture in enumerate(np.load(array(folder))):
        cv2.imwrite(str(pictures / f"frame-{number}.png"), picture)
    return pictures


def make_film(folder: Path) -> Path:
    """A recording as a video of 1000 frames."""
    path = folder / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (160, 120))
    for picture in np.load(array(folder, 1000)):
        writer.write(picture)
    writer.release()
    return path


def make_recording(folder: Path) -> Path:
    """A recording of ours."""
    path = folder / "press.mcap"
    run(folder, {"record": {"path": str(path), "preview": 0}}, source=str(array(folder)))
    return path


MAKE: dict[str, tuple[Callable[[Path], Path], int]] = {
    "array": (lambda folder: array(folder, LONG), LONG),
    "pictures": (make_pictures, FRAMES),
    "film": (make_film, 1000),
    "mcap": (make_recording, FRAMES),
}
"""Kind of recording -> how it is made, and its frames."""


def _one(source: Path) -> Path:
    """The file itself, or the 91st of a folder."""
    return source / "frame-90.png" if source.is_dir() else source


def _remove(source: Path) -> None:
    shutil.rmtree(source) if source.is_dir() else source.unlink()


def _cut(source: Path) -> None:
    """Cut it to a half; a recording of pictures, one of them."""
    file = _one(source)
    with file.open("r+b") as opened:
        opened.truncate(file.stat().st_size // 2)


def _garble(source: Path) -> None:
    """Zeros in the place of 100 bytes, near the end."""
    file = _one(source)
    with file.open("r+b") as opened:
        opened.seek(file.stat().st_size * 9 // 10)
        opened.write(bytes(100))


FAULTS: dict[str, Callable[[Path], object]] = {
    "removed": _remove,
    "cut": _cut,
    "corrupt": _garble,
    "something else": lambda source: _one(source).write_bytes(b"somebody else's" * 10),
    "another size": lambda source: cv2.imwrite(str(_one(source)), np.zeros((60, 80, 3), np.uint8)),
}


@pytest.mark.parametrize(
    ("kind", "fault", "at_start", "code", "said", "results"),
    [
        ("array", "removed", False, 0, "^$", "all"),
        ("array", "cut", False, 4, "cut off during the run", "up to there"),
        ("array", "corrupt", False, 0, "^$", "all"),
        ("pictures", "removed", False, 4, r"frame-\d+.png: cannot be read", "up to there"),
        ("pictures", "cut", False, 4, "frame-90.png: the image is cut off", "up to there"),
        ("pictures", "corrupt", True, 4, "frame-90.png: not an image", "up to there"),
        ("pictures", "another size", True, 4, "80 x 60 pixels", "up to there"),
        ("film", "cut", False, 0, "ended after .* may be damaged", "up to there"),
        ("mcap", "cut", True, 0, "was not finished.*tactflow repair", "up to there"),
        ("mcap", "corrupt", True, 4, "is damaged.*tactflow repair", "up to there"),
        ("mcap", "removed", False, 0, "^$", "all"),
        ("mcap", "something else", False, 4, "is damaged", "up to there"),
    ],
)
def test_something_happens_to_a_recording(
    kind: str, fault: str, at_start: bool, code: int, said: str, results: str, tmp_path: Path
) -> None:
    make, whole = MAKE[kind]
    source, out = make(tmp_path), tmp_path / "out.jsonl"
    if at_start:
        FAULTS[fault](source)

    def in_mid_run(_: Runner) -> None:
        if not at_start:
            FAULTS[fault](source)

    _, seen = run(tmp_path, {"jsonl": {"path": str(out)}}, in_mid_run, source=str(source))
    lines = len(out.read_text().splitlines()) if out.exists() else 0
    kept = "all" if lines == whole else "up to there" if lines else "none"
    Seen(seen.exit, seen.said, kept).must_be(code, said, f"^{results}$")


@pytest.mark.parametrize(
    ("does", "said", "given_up"),
    [
        ("gone", "is gone since.*is back", "gone, no good frame"),
        ("ends", "is gone since.*is back", "gone, no good frame"),
        ("frozen", "a frozen picture since.*is back", "a frozen picture, no good frame"),
        ("black", "black pictures since.*is back", "black pictures, no good frame"),
        ("other_size", "is back", "32 x 24 pixels instead of 64 x 48"),
    ],
)
@pytest.mark.parametrize("comes_back", [True, False])
def test_a_camera_fails_in_mid_run(
    does: str, said: str, given_up: str, comes_back: bool, tmp_path: Path
) -> None:
    Scripted.device = device = Flaky()
    out = tmp_path / "out.jsonl"

    def fault(_: Runner) -> None:
        if comes_back:
            # One whose pictures are bad is opened anew when that shows, and is good then.
            device.fail(does, openings=1 if does in ("frozen", "black") else 3)
        else:
            device.does = does

    camera = {"use": f"{__name__}:Scripted", "source": "0", "no_frame_timeout": 0 if comes_back else 3.0}
    try:
        _, seen = run(tmp_path, {"jsonl": {"path": str(out)}}, fault, max_frames=2 * FAULT_AT, **camera)
    finally:
        device.free.set()
    seqs = [json.loads(line)["seq"] for line in out.read_text().splitlines()]
    assert seqs == sorted(set(seqs))
    kept = "before and after" if seqs[-1] > FAULT_AT + 30 else "before"
    expected = (0, said, "before and after") if comes_back else (4, given_up, "^before$")
    Seen(seen.exit, seen.said, kept).must_be(*expected)
    if comes_back:
        assert len(seen.said.splitlines()) == 2, "it is reported once, and so is its end"
