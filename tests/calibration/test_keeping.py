"""A live session that is broken off loses no press, and goes on only where it still fits."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactflow.calibration.keeping import KeptPresses
from tactflow.calibration.presses import Press, PressFinder
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
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


def result(seq: int, gel: np.ndarray, *, touched: bool, reference: bool = False, epoch: int = 0) -> Result:
    """A frame of a session."""
    mask = MASK.copy()
    mask[10:20, 10:20] = 255 if touched else 0
    contact = Contact(100.0, (14.5, 14.5), None, None, np.zeros((0, 2)), None)
    frame = Frame("main", seq, seq / 60, gel, reference=reference, epoch=epoch)
    found = {"contact": contact, "contact_mask": mask} if touched else {}
    return Result(frame, {"image": gel, "mapping": MAPPING, **found})


@pytest.mark.parametrize(("brighter", "left"), [(2, 2), (20, 1)])
def test_a_new_reference_replaces_the_one_before_and_presses_of_another_look_are_left_out(
    brighter: int, left: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kept, finder = KeptPresses(tmp_path / "main.presses"), PressFinder()
    changed = np.asarray(GEL + brighter, np.uint8)
    for seq, (gel, touched) in enumerate(
        [
            (GEL, False),
            (GEL, True),
            (GEL, False),
            (changed, False),
            (changed, False),
            (changed, True),
            (changed, False),
        ]
    ):
        finder.add(result(seq, gel, touched=touched, reference=seq in (0, 3), epoch=int(seq > 2)))
        kept.update(finder)
    assert np.array_equal(finder.untouched, changed)
    assert len(finder.presses) == len(KeptPresses(kept.folder).presses) == left
    assert ("1, are left out" in caplog.text) == (left == 1)


def test_a_live_session_goes_on_with_the_presses_of_the_one_before(tmp_path: Path) -> None:
    counts = []
    for _ in range(2):
        kept, finder = KeptPresses(tmp_path / "main.presses"), PressFinder()
        finder.presses[:] = kept.presses
        for seq in range(9):
            finder.add(result(seq, GEL, touched=seq % 3 == 1, reference=seq == 0))
            kept.update(finder)
        counts.append(len(finder.presses))
    assert counts == [3, 6]
