"""Where results come from, for files that outlive the run: versions, source, pipeline, calibration."""

from __future__ import annotations

import logging
import platform
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import yaml

from tactflow import __version__
from tactflow.calibration.stored import stored_arrays, stored_text
from tactflow.engine.control import Control
from tactflow.system.redaction import without_secrets

log = logging.getLogger("tactflow")


def facts(sensor: str, control: Control | None) -> dict[str, str]:
    """Versions, machine, sensor and, of a run, the source: name -> text.

    >>> facts("main", None)["sensor"]
    'main'
    """
    found = {
        "tactflow": __version__,
        "numpy": np.__version__,
        "numba": version("numba"),
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "sensor": sensor,
    }
    if control is not None:
        found["source"] = str((control.source and control.source.description) or "")
    return found


def arrays(control: Control | None) -> dict[str, bytes]:
    """`calibration.npz`, which belongs to the `calibration.yaml` of `texts`: name -> bytes."""
    calibration = None if control is None else control.pipeline.calibration
    if calibration is None:
        return {}
    try:
        return {"calibration.npz": stored_arrays(calibration)}
    except (OSError, ValueError) as error:
        log.debug("%s: its arrays are not kept: %s", calibration, error)
        return {}


def texts(control: Control | None) -> dict[str, str]:
    """The files of a run, without passwords: name -> text.

    `pipeline.yaml` has every override, `pipeline.original.yaml` is the file as it was written,
    `calibration.yaml` the sensor's calibration, where it has one.
    """
    if control is None:
        return {}
    pipeline = control.pipeline
    found = {"pipeline.yaml": without_secrets(yaml.safe_dump(dict(pipeline.settings), sort_keys=False))}
    files = {"pipeline.original.yaml": Path(pipeline.file)}
    if pipeline.calibration is not None:
        files["calibration.yaml"] = pipeline.calibration
    for name, file in files.items():
        try:
            data = stored_text(file) if file == pipeline.calibration else file.read_bytes()
            found[name] = without_secrets(data.decode("utf-8"))
        except (OSError, ValueError) as error:
            log.debug("%s: not kept: %s", file, error)
    return found
