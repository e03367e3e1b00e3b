"""Presses of a live session on disk, so that Ctrl-C or a crash loses none and the session can go on."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tactflow.calibration.file import raw_corners
from tactflow.calibration.presses import SAME, Picture, Press, PressFinder, difference
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import completed
from tactflow.vision.geometry import PixelMapping


class KeptPresses:
    """A folder with a file for each press, and one for the untouched gel they are compared with.

    folder : made when there is something to keep. presses : those of the session so far.

    Raises ConfigError if a file in it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.presses: list[Press] = []
        self._checked = False
        self._renewed = 0
        for path in sorted(folder.glob("press-*.npz")):
            stored = _read(path)
            x, y = stored.pop("center").tolist()
            seq, radius = int(stored.pop("seq")), float(stored.pop("radius"))
            self.presses.append(Press(seq=seq, radius=radius, center=(x, y), **stored))

    def update(self, finder: PressFinder) -> None:
        """Save the presses that are over, and delete those that were undone or belong to another look.

        Raises
        ------
        ConfigError : the frames or the light are others than in the session so far.
        """
        if finder.renewed != self._renewed:
            self.clear()
            self._checked, self._renewed = False, finder.renewed
        if finder.lasts and not self._checked:
            self.check(finder.untouched, finder.mapping)
            self._checked = True
        self.sync(finder.presses[: len(finder.presses) - finder.lasts])

    def check(self, untouched: Picture, mapping: PixelMapping) -> None:
        """Refuse to go on with other frames or another light than those of the first session.

        Raises ConfigError, with what differs.
        """
        path, corners = self.folder / "untouched.npz", raw_corners(mapping)
        if not path.exists():
            _save(path, untouched=untouched, corners=corners)
            return
        before = _read(path)
        remedy = f"start over with --fresh, which discards the {len(self.presses)} presses in {self.folder}"
        same_shape = before["untouched"].shape == untouched.shape
        if not same_shape or np.abs(np.subtract(before["corners"], corners)).max() > 1:
            raise ConfigError(f"calibrate: the session of before had another preprocess; {remedy}")
        differs = difference(untouched, before["untouched"])
        if differs > SAME:
            raise ConfigError(
                f"calibrate: the untouched gel differs by {100 * differs:.0f} % of its brightness from the "
                f"session of before ({100 * SAME:.0f} % at most): lift what touches it, or {remedy}"
            )

    def sync(self, presses: Sequence[Press]) -> None:
        """Save new presses and delete the files of those that are gone."""
        same = 0
        while same < min(len(self.presses), len(presses)) and self.presses[same] is presses[same]:
            same += 1
        for number in range(same, len(self.presses)):
            self._path(number).unlink(missing_ok=True)
        for number in range(same, len(presses)):
            _save(self._path(number), **asdict(presses[number]))
        self.presses = [*presses]

    def clear(self) -> None:
        """Delete all of them."""
        self.presses = []
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, number: int) -> Path:
        return self.folder / f"press-{number + 1:04d}.npz"


def _save(path: Path, **arrays: Any) -> None:
    """Raises StageError if it cannot be written."""
    try:
        with completed(path) as partial, partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
    except OSError as error:
        raise StageError(
            f"presses are kept in {path.parent}, which cannot be written into: {error.strerror or error}; "
            "make room, or name another folder with --out"
        ) from error


def _read(path: Path) -> dict[str, Any]:
    """Raises ConfigError if it cannot be read."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except Exception as error:
        # ZIP and numpy raise many kinds of errors about damaged data.
        raise ConfigError(f"{path}: cannot be read: {error}; remove it") from None
