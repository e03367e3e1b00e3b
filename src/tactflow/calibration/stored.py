"""Where a calibration is stored: in files of its own, in the recording that was made with it, or in the
package, if it is of a kind of sensor."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from tactflow.engine.errors import SourceError
from tactflow.engine.graph import Pipeline

MAX_ARRAYS: Final = 1 << 20
"""Size limit of the arrays, packed and unpacked, bytes; ours have some thousands."""
MAX_TEXT: Final = 1 << 17
"""Size limit of the YAML file, bytes; ours have some thousands. PyYAML takes 4 s for so many."""

KINDS: Final = Path(__file__).parent / "kinds"
"""Folder of the calibrations of kinds of sensors that come with the package."""


def kinds() -> list[str]:
    """Names of the kinds of sensors that the package has a calibration for."""
    return sorted(path.stem for path in KINDS.glob("*.yaml"))


def stored_text(path: Path) -> bytes:
    """The YAML file of a calibration: the file itself, or the one attached to a recording.

    Raises OSError or ValueError if it is missing, or larger than any calibration.
    """
    return _stored(path, "calibration.yaml", MAX_TEXT)


def stored_arrays(path: Path) -> bytes:
    """The `.npz` file of a calibration; as `stored_text`."""
    return _stored(path, "calibration.npz", MAX_ARRAYS)


def with_recorded_calibration(pipeline: Pipeline) -> Pipeline:
    """The pipeline with the calibration that its recording was made with.

    One that names a calibration itself, or null, stays as it is; the default of a kind of sensor gives way.
    """
    source = getattr(pipeline.source.params, "source", None)
    name = source.partition("?")[0] if isinstance(source, str) else ""
    chosen = pipeline.calibration is not None and pipeline.calibration.parent != KINDS
    if chosen or pipeline.settings.get("calibration", "") is None or not name.endswith(".mcap"):
        return pipeline
    from tactflow.recording import missing_packages
    from tactflow.sources.paths import find_path

    if missing_packages() is not None:
        return pipeline
    from tactflow.recording.records import NotARecordingError

    # The source reports what is wrong with the recording itself.
    with suppress(SourceError, OSError, ValueError, NotARecordingError):
        path = find_path(name, pipeline.directory)
        stored_text(path)
        return replace(pipeline, calibration=path)
    return pipeline


def _stored(path: Path, name: str, limit: int) -> bytes:
    if path.suffix == ".mcap":
        from tactflow.recording import CALIBRATION
        from tactflow.recording.reader import attachments

        attached = attachments(path)
        if not attached.keys() >= CALIBRATION:
            raise ValueError("the recording was made without a calibration")
        data = attached[name]
    else:
        with path.with_suffix(Path(name).suffix).open("rb") as file:
            data = file.read(limit + 1)
    if len(data) > limit:
        raise ValueError(f"its {Path(name).suffix} is larger than {limit >> 10} KiB")
    return data
