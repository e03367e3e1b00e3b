"""Provenance of results, for output files: versions, source, pipeline, calibration."""

from __future__ import annotations

import logging
import platform

import cv2
import numpy as np
import yaml

from tactflow import __version__
from tactflow.engine.control import Control
from tactflow.recording.calibration import stored_arrays, stored_text
from tactflow.system.redaction import public_address, without_secrets

log = logging.getLogger("tactflow")


def facts(sensor: str, control: Control | None) -> dict[str, str]:
    """Versions, machine, sensor and, for a run, the source: name -> text.

    >>> facts("main", None)["sensor"]
    'main'
    """
    texts = {
        "tactflow": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "sensor": sensor,
    }
    if control is not None:
        texts["source"] = str((control.source and control.source.description) or "")
    return texts


def kept_files(control: Control | None) -> dict[str, bytes]:
    """The files of a run without passwords: name -> content.

    `pipeline.yaml` includes all overrides, `calibration.yaml` and `calibration.npz` are the sensor's
    calibration, if any.
    """
    if control is None:
        return {}
    settings = without_secrets(dict(control.pipeline.settings))
    files = {"pipeline.yaml": yaml.safe_dump(settings, sort_keys=False).encode()}
    calibration = control.pipeline.calibration
    if calibration is not None:
        try:
            text = public_address(stored_text(calibration).decode()).encode()
            files |= {"calibration.yaml": text, "calibration.npz": stored_arrays(calibration)}
        except (OSError, ValueError) as error:
            log.debug("the calibration is not kept: %s", error)
    return files
