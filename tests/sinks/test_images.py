"""The images sink: numbered files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.images import Images


def picture(seq: int) -> np.ndarray:
    return np.random.default_rng(seq).integers(0, 256, (24, 32, 3), np.uint8)


def run(folder: Path, seqs: list[int], **params: Any) -> Images:
    sink = Images(Images.Params(folder=str(folder), **params))
    try:
        sink.open()
        for seq in seqs:
            sink.write(Tick(Frame("main", seq, 0.0, picture(seq))), picture(seq))
    finally:
        sink.close()
    return sink


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_png_files_are_numbered_by_seq_and_keep_every_bit(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    sink = run(folder, [0, 36])
    assert names(folder) == ["frame-000000.png", "frame-000036.png"]
    np.testing.assert_array_equal(cv2.imread(str(folder / "frame-000036.png")), picture(36))
    assert sink.counters() == {"files": 2}


def test_jpg_files_are_smaller_with_less_quality(tmp_path: Path) -> None:
    sizes = []
    for quality in (95, 20):
        folder = tmp_path / str(quality)
        run(folder, [7], format="jpg", quality=quality)
        sizes.append((folder / "frame-000007.jpg").stat().st_size)
    assert sizes[1] < sizes[0]
