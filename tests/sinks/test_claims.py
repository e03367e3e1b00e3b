"""Two runs that would write to one place: the second one is refused, and the first loses nothing."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tactflow.engine.contract import Sink
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.images import Images
from tactflow.sinks.jsonl import Jsonl
from tactflow.sinks.video import Video
from tests.messages import Results, result_of

PICTURE = np.zeros((48, 64, 3), np.uint8)


def lines(folder: Path) -> Sink:
    return Jsonl(Jsonl.Params(path=str(folder / "a.jsonl"), overwrite=True, flush=0.0))


def images(folder: Path) -> Sink:
    return Images(Images.Params(folder=str(folder / "a"), overwrite=True))


def video(folder: Path) -> Sink:
    return Video(Video.Params(path=str(folder / "a.avi"), overwrite=True, fps=30.0))


def write(sink: Sink, seq: int) -> None:
    tick = Tick(Frame("main", seq, seq / 30, PICTURE))
    if isinstance(sink, Jsonl):
        sink.write(result_of(tick, Results()))
    else:
        sink.write(tick, PICTURE)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows itself refuses")
@pytest.mark.parametrize("make", [lines, images, video])
def test_what_a_run_writes_is_taken_from_it_by_no_other(make: Callable[[Path], Sink], tmp_path: Path) -> None:
    first, second = make(tmp_path), make(tmp_path)
    first.open()
    write(first, 0)

    def start() -> None:
        second.open()
        write(second, 1)

    with pytest.raises(StageError, match="another run is writing to it"):
        start()
    second.close()
    write(first, 2)
    first.close()
    written = sum(file.stat().st_size for file in tmp_path.rglob("*"))
    third = make(tmp_path)
    third.open()
    write(third, 3)
    third.close()
    assert written > 0
    assert len(os.listdir(tmp_path)) == 1
