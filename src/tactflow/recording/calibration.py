"""The two files of a calibration as bytes: on disk, or attached to the recording that was made with it."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from tactflow.recording import CALIBRATION_ATTACHMENTS

MAX_ARRAY_BYTES: Final = 1 << 20
"""Size limit of the arrays, packed and unpacked, bytes; ours have some thousands."""
MAX_TEXT_BYTES: Final = 1 << 17
"""Size limit of the YAML file, bytes; ours have some thousands. PyYAML takes 4 s for so many."""


def stored_text(path: Path) -> bytes:
    """The YAML file of a calibration: the file itself, or the one attached to a recording (`.mcap`).

    Raises OSError or ValueError if it is missing, or larger than any calibration.
    """
    return _stored(path, "calibration.yaml", MAX_TEXT_BYTES)


def stored_arrays(path: Path) -> bytes:
    """The `.npz` file of a calibration; as `stored_text`."""
    return _stored(path, "calibration.npz", MAX_ARRAY_BYTES)


def _stored(path: Path, name: str, limit: int) -> bytes:
    if path.suffix == ".mcap":
        from tactflow.recording.reader import attachments

        attached = attachments(path)
        if not attached.keys() >= CALIBRATION_ATTACHMENTS:
            raise ValueError("the recording was made without a calibration")
        data = attached[name]
    else:
        with path.with_suffix(Path(name).suffix).open("rb") as file:
            data = file.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"its {Path(name).suffix} is larger than {limit >> 10} KiB")
    return data
