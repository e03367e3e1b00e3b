"""Installed packages: those of an extra that are missing, and OpenCV packages that overwrite each other."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata

from tactflow.system.spelling import joined

OPENCV = "opencv-python-headless"
"""The OpenCV package that tactflow depends on."""


def missing(what: str, extra: str, modules: Sequence[str]) -> str | None:
    """Why something cannot be done here and what to install, or None.

    what : in the plural, at the beginning of the sentence. extra : of tactflow, as in
    `pip install 'tactflow[record]'`. modules : that must be there, top level.

    >>> missing("recordings", "record", ["json", "no_such_module"])
    "recordings need no_such_module: pip install 'tactflow[record]'"
    """
    absent = [name for name in modules if importlib.util.find_spec(name) is None]
    if not absent:
        return None
    return f"{what} need {joined(absent)}: pip install 'tactflow[{extra}]'"


def opencv_conflict() -> str | None:
    """What is wrong where several OpenCV packages are installed, and what to do, or None. Takes 20 ms."""
    found: dict[str, str] = {}
    for name in ("opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless", OPENCV):
        with suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    if len(found) < 2:
        return None
    names = " and ".join(f"{name} {number}" for name, number in found.items())
    return (
        f"{names} are installed together and overwrite each other's files, so that it is left to chance "
        f"which one runs; to repair it: pip uninstall --yes {' '.join(found)}, then pip install {OPENCV}"
    )
