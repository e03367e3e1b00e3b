"""Presses of a live session on disk, so that Ctrl-C or a crash loses none and the session can go on."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.file import raw_corners
from tactflow.calibration.presses import SAME, Press, difference
from tactflow.engine.errors import ConfigError, StageError
from tactflow.system.files import completed
from tactflow.vision.geometry import PixelMapping


class KeptPresses:
    """A folder with a file for each press, and one for the untouched gel they are compared with.

    folder : made when there is something to keep.

    Raises ConfigError if what is in it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._saved: list[tuple[Press, Path]] = []
        try:
            for path in sorted(folder.glob("press-*.npz")):
                self._saved.append((_read(path), path))
        except Exception as error:
            raise _unreadable(path, error) from None

    @property
    def presses(self) -> list[Press]:
        """Those of before."""
        return [press for press, _ in self._saved]

    def check(self, untouched: NDArray[np.uint8], mapping: PixelMapping) -> None:
        """Refuse to go on with other frames or another light; the first session says what they are.

        Raises ConfigError, with what differs.
        """
        path, corners = self.folder / "untouched.npz", raw_corners(mapping)
        if not path.exists():
            _save(path, untouched=untouched, corners=corners)
            return
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as before:
                then, where = before["untouched"], before["corners"]
        except Exception as error:
            raise _unreadable(path, error) from None
        remedy = f"begin anew with --fresh, which forgets the {len(self._saved)} presses in {self.folder}"
        if then.shape != untouched.shape or np.abs(where - corners).max() > 1:
            raise ConfigError(f"calibrate: the session of before had another preprocess; {remedy}")
        differs = difference(untouched, then)
        if differs > SAME:
            raise ConfigError(
                f"calibrate: the untouched gel differs by {100 * differs:.0f} % of its brightness from the "
                f"session of before ({100 * SAME:.0f} % at most): lift what touches it, or {remedy}"
            )

    def sync(self, presses: Sequence[Press]) -> None:
        """Save those that are new, forget those that are no more."""
        there = {id(press) for press in presses}
        for press, path in self._saved:
            if id(press) not in there:
                path.unlink(missing_ok=True)
        self._saved = [pair for pair in self._saved if id(pair[0]) in there]
        saved = {id(press) for press, _ in self._saved}
        for press in presses:
            if id(press) not in saved:
                number = int(self._saved[-1][1].stem[6:]) + 1 if self._saved else 1
                self._saved.append((press, self.folder / f"press-{number:04d}.npz"))
                _save(
                    self._saved[-1][1],
                    seq=press.seq,
                    image=press.image,
                    mask=press.mask,
                    hidden=press.hidden,
                    center=press.center,
                    radius=press.radius,
                )

    def clear(self) -> None:
        """Forget all of them."""
        self._saved = []
        shutil.rmtree(self.folder, ignore_errors=True)


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


def _unreadable(path: Path, error: Exception) -> ConfigError:
    """What ZIP and numpy raise about damaged data is many things."""
    return ConfigError(f"{path}: cannot be read: {error}; remove it")


def _read(path: Path) -> Press:
    with path.open("rb") as file, np.load(file, allow_pickle=False) as said:
        x, y = said["center"].tolist()
        return Press(
            int(said["seq"]), said["image"], said["mask"], said["hidden"], (x, y), float(said["radius"])
        )
