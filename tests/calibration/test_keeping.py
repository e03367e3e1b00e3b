"""A live session that is broken off loses no press, and goes on only where it still fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tactflow.calibration.keeping import KeptPresses
from tactflow.calibration.presses import Press, _Collect
from tactflow.engine.contract import StageParams
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.frame import Frame, Tick
from tactflow.vision.geometry import PixelMapping
from tactflow.vision.types import Contact

GEL = np.full((40, 60, 3), 100, np.uint8)
MASK = np.zeros((40, 60), np.uint8)
MAPPING = PixelMapping.identity((60, 40))
PRESS = Press(7, GEL, MASK, MASK > 0, (20.0, 30.0), 5.0)


def test_presses_that_are_kept_are_there_again_without_those_that_were_undone(tmp_path: Path) -> None:
    kept = KeptPresses(tmp_path / "main.presses")
    presses = [replace(PRESS, seq=number) for number in range(3)]
    for count in range(1, 4):
        kept.sync(presses[:count])
    kept.sync([presses[0], presses[2]])
    again = KeptPresses(tmp_path / "main.presses")
    assert [press.seq for press in again.presses] == [0, 2]
    again.sync([*again.presses, replace(PRESS, seq=9)])
    last = KeptPresses(tmp_path / "main.presses").presses
    assert [press.seq for press in last] == [0, 2, 9]
    assert (last[0].center, last[0].radius) == (PRESS.center, PRESS.radius)
    assert np.array_equal(last[0].image, GEL)
    again.clear()
    assert not KeptPresses(tmp_path / "main.presses").presses


def test_a_session_does_not_go_on_with_another_light_or_other_frames(tmp_path: Path) -> None:
    kept = KeptPresses(tmp_path / "main.presses")
    kept.check(GEL, MAPPING)
    kept.check(GEL + 1, MAPPING)
    with pytest.raises(ConfigError, match=r"differs by 20 % .* --fresh"):
        kept.check(GEL + 20, MAPPING)
    with pytest.raises(ConfigError, match="had another preprocess"):
        kept.check(np.ascontiguousarray(GEL[:20]), PixelMapping.identity((60, 20)))


def test_a_kept_press_that_is_damaged_is_named(tmp_path: Path) -> None:
    for damaged in (b"PK no", b"PK\x03\x04 cut short", b""):
        (tmp_path / "press-0001.npz").write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"press-0001\.npz: cannot be read"):
            KeptPresses(tmp_path)
    (tmp_path / "press-0001.npz").unlink()
    kept = KeptPresses(tmp_path)
    (tmp_path / "untouched.npz").write_bytes(b"PK\x03\x04 cut short")
    with pytest.raises(ConfigError, match=r"untouched\.npz: cannot be read"):
        kept.check(GEL, MAPPING)


def test_presses_that_cannot_be_kept_are_told_in_words(tmp_path: Path) -> None:
    (tmp_path / "main.presses").touch()
    with pytest.raises(StageError, match=r"main\.presses, which cannot be written into: .* --out"):
        KeptPresses(tmp_path / "main.presses").sync([PRESS])


class LiveSink(_Collect):
    """The sink of `find_presses`, at a live source, with nobody who guides."""

    report = staticmethod(lambda _frames, _presses, _lasts: False)


@pytest.mark.parametrize(("brighter", "left"), [(2, 2), (20, 1)])
def test_a_new_reference_replaces_the_one_before_and_presses_of_another_look_are_left_out(
    brighter: int, left: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    live: Any = SimpleNamespace(source=SimpleNamespace(live=True))
    kept = KeptPresses(tmp_path / "main.presses")
    sink = LiveSink(StageParams(), live)
    sink.keeper = lambda: kept
    sink.open()
    contact = Contact(100.0, (14.5, 14.5), None, None, np.zeros((0, 2)), None)
    changed = np.asarray(GEL + brighter, np.uint8)
    for seq, (gel, touched) in enumerate(
        [(GEL, 0), (GEL, 1), (GEL, 0), (changed, 0), (changed, 0), (changed, 1)]
    ):
        tick = Tick(Frame("main", seq, seq / 60, gel, reference=seq in (0, 3), epoch=int(seq > 2)))
        sink.write(tick, gel, contact if touched else None, MASK, None, None, MAPPING)
    sink.write(Tick(Frame("main", 9, 1.0, changed, epoch=1)), changed, None, MASK, None, None, MAPPING)
    assert np.array_equal(sink.untouched(), changed)
    assert len(sink.presses) == len(KeptPresses(kept.folder).presses) == left
    assert ("1, are left out" in caplog.text) == (left == 1)


def test_a_live_session_begins_with_the_presses_of_the_one_before(tmp_path: Path) -> None:
    live: Any = SimpleNamespace(source=SimpleNamespace(live=True))
    touched = MASK.copy()
    touched[10:20, 10:20] = 255
    contact = Contact(100.0, (14.5, 14.5), None, None, np.zeros((0, 2)), None)
    counts = []
    for _ in range(2):
        sink = LiveSink(StageParams(), live)
        sink.keeper = lambda: KeptPresses(tmp_path / "main.presses")
        sink.open()
        for seq in range(9):
            now = contact if seq % 3 == 1 else None
            tick = Tick(Frame("main", seq, seq / 60, GEL, reference=seq == 0))
            sink.write(tick, GEL, now, touched, None, None, MAPPING)
        counts.append(len(sink.presses))
    assert counts == [3, 6]
