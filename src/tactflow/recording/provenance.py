"""Provenance of results, for output files: versions, source, pipeline, calibration."""

from __future__ import annotations

import logging
import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import yaml

from tactflow import __version__
from tactflow.engine.control import Control
from tactflow.recording.calibration import stored_arrays, stored_text
from tactflow.system.redaction import without_secrets

log = logging.getLogger("tactflow")


def facts(sensor: str, control: Control | None) -> dict[str, str]:
    """Versions, machine, sensor and, for a run, the source: name -> text.

    >>> facts("main", None)["sensor"]
    'main'
    """
    texts = {
        "tactflow": __version__,
        "numpy": np.__version__,
        "numba": version("numba"),
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

    `pipeline.yaml` includes all overrides, `pipeline.original.yaml` is the original file, `calibration.yaml`
    and `calibration.npz` are the sensor's calibration, if any.
    """
    if control is None:
        return {}
    pipeline = control.pipeline
    calibration = pipeline.calibration
    readers: dict[str, Callable[[], bytes]] = {
        "pipeline.yaml": lambda: yaml.safe_dump(dict(pipeline.settings), sort_keys=False).encode(),
        "pipeline.original.yaml": Path(pipeline.file).read_bytes,
    }
    if calibration is not None:
        readers["calibration.yaml"] = lambda: stored_text(calibration)
        readers["calibration.npz"] = lambda: stored_arrays(calibration)
    files = {}
    for name, read in readers.items():
        try:
            data = read()
            is_text = name.endswith(".yaml")
            files[name] = without_secrets(data.decode("utf-8")).encode() if is_text else data
        except (OSError, ValueError) as error:
            log.debug("%s is not kept: %s", name, error)
    return files
