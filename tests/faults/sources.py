"""Faults of sources: gone, cut, corrupt, of another size, frozen."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from tactflow.engine.run import Runner
from tests.faults.rig import FAULT_AT, FRAMES, Scripted, Seen, array, run
from tests.sources.flaky import Flaky

LONG = 2000
"""Frames of a recording from which a run takes only some, so that much of it is still unread at the fault."""


def make_array(folder: Path) -> Path:
    """A recording as an array."""
    return array(folder, LONG)


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


MAKE: dict[str, Callable[[Path], Path]] = {
    "array (.npy)": make_array,
    "folder of pictures": make_pictures,
    "video file": make_film,
    "recording (.mcap)": make_recording,
}


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


def _replace(source: Path) -> None:
    _one(source).write_bytes(b"somebody else's" * 10)


def _resize(source: Path) -> None:
    """One picture of another size."""
    cv2.imwrite(str(_one(source)), np.zeros((60, 80, 3), np.uint8))


FAULTS: dict[str, Callable[[Path], None]] = {
    "not there": _remove,
    "removed": _remove,
    "cut": _cut,
    "corrupt": _garble,
    "something else": _replace,
    "one picture of another size": _resize,
}


def recording(kind: str, fault: str, folder: Path, *, at_start: bool) -> Seen:
    """Something happens to a recording, before the run or in the middle of it."""
    source, out = MAKE[kind](folder), folder / "out.jsonl"
    if at_start:
        FAULTS[fault](source)

    def in_mid_run(_: Runner) -> None:
        if not at_start:
            FAULTS[fault](source)

    sinks = {"jsonl": {"path": str(out)}}
    _, seen = run(folder, sinks, in_mid_run, source=str(source))
    lines = len(out.read_text().splitlines()) if out.exists() else 0
    whole = {"array (.npy)": LONG, "video file": 1000}.get(kind, FRAMES)
    kept = "all results" if lines == whole else "results up to there" if lines else "nothing"
    return Seen(seen.exit, seen.said, kept)


def camera(does: str, folder: Path, *, comes_back: bool) -> Seen:
    """A camera does something bad in the middle of a run."""
    Scripted.device = device = Flaky()
    out = folder / "out.jsonl"

    def fault(_: Runner) -> None:
        if comes_back and does in ("frozen", "black"):
            # It is opened anew when that shows, and then is good.
            device.fail(does, openings=1)
        elif comes_back:
            device.fail(does, openings=3)
        else:
            device.does = does

    try:
        _, seen = run(
            folder,
            {"jsonl": {"path": str(out)}},
            fault,
            max_frames=2 * FAULT_AT,
            use="tests.faults.rig:Scripted",
            source="0",
            no_frame_timeout=0 if comes_back else 3.0,
        )
    finally:
        device.free.set()
    seqs = [json.loads(line)["seq"] for line in out.read_text().splitlines()]
    assert seqs == sorted(set(seqs))
    return Seen(
        seen.exit, seen.said, "results before and after" if seqs[-1] > FAULT_AT + 30 else "results before"
    )
