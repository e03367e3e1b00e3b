"""Missing packages of extras, and conflicting OpenCV packages."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata

from tactflow.system.spelling import joined

OPENCV = "opencv-python-headless"
"""The OpenCV package that tactflow depends on."""


def missing(feature: str, extra: str, modules: Sequence[str]) -> str | None:
    """A message about packages that are not installed, with the remedy; None if all are.

    feature : in the plural. extra : of tactflow, as in `pip install 'tactflow[record]'`. modules : required
    top-level modules.

    >>> missing("recordings", "record", ["json", "no_such_module"])
    "recordings need no_such_module: pip install 'tactflow[record]'"
    """
    absent = [name for name in modules if importlib.util.find_spec(name) is None]
    if not absent:
        return None
    return f"{feature} need {joined(absent)}: pip install 'tactflow[{extra}]'"


def opencv_conflict() -> str | None:
    """A message if several OpenCV packages are installed, with the remedy, or None. Takes 20 ms."""
    versions: dict[str, str] = {}
    for name in ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless", OPENCV):
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    if len(versions) < 2:
        return None
    names = " and ".join(f"{name} {number}" for name, number in versions.items())
    return (
        f"{names} are installed together and overwrite each other's files, so that it is left to chance "
        f"which one runs; to repair it: pip uninstall --yes {' '.join(versions)}, then pip install {OPENCV}"
    )
