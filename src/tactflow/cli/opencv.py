"""Warns of two OpenCV packages in one environment: they bring the same files and overwrite each other's."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import metadata

NEEDED = "opencv-contrib-python-headless"
"""The package that tactflow depends on."""
PACKAGES = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", NEEDED)
"""All that install `cv2`; which one's files are there is decided by what was installed last."""


def opencv_conflict(version: Callable[[str], str] = metadata.version) -> str | None:
    """What is wrong with the installed OpenCV packages and what to do about it, or None.

    version : gives the version of an installed package, or raises `PackageNotFoundError`.
    """
    found: dict[str, str] = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except metadata.PackageNotFoundError:
            continue
    if len(found) < 2:
        return None
    names = " and ".join(f"{name} {number}" for name, number in found.items())
    return (
        f"{names} are installed together and overwrite each other's files, so that it is left to chance "
        f"which one runs; to mend it: pip uninstall --yes {' '.join(found)}, then pip install {NEEDED}"
    )


def warn_of_conflict() -> None:
    """Say so on standard error, if there is something to say. Takes some 20 ms (two busy cores)."""
    problem = opencv_conflict()
    if problem is not None:
        print(f"tactflow: WARNING: {problem}", file=sys.stderr)
