"""Several installed packages of OpenCV, which all own the folder `cv2`."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

REQUIRED_PACKAGE: Final = "opencv-contrib-python-headless"
"""The package that tactflow depends on; the others are subsets of it, or have windows."""


def opencv_conflict(packages: Path, *, has_contrib: bool) -> str | None:
    """A message if OpenCV is installed by several packages that are not the same, with the remedy; else None.

    The package installed last overwrites the files of the others. Versions are read from the names of
    folders: `importlib.metadata` takes 40 ms.

    packages : the folder that holds `cv2`. has_contrib : whether `cv2` has the modules of contrib.
    """
    pattern = re.compile(r"(opencv_(?:contrib_)?python(?:_headless)?)-([^-]+)\.dist-info")
    found = filter(None, map(pattern.fullmatch, os.listdir(packages)))
    versions = {match[1].replace("_", "-"): match[2] for match in found}
    others = {name: version for name, version in versions.items() if name != REQUIRED_PACKAGE}
    agree = len(set(versions.values())) == 1 and (has_contrib or REQUIRED_PACKAGE not in versions)
    if len(versions) < 2 or agree:
        return None
    listed = ", ".join(f"{name} {version}" for name, version in sorted(versions.items()))
    return (
        f"{len(versions)} packages of OpenCV have overwritten each other: {listed}; make them agree: pip "
        f"install --force-reinstall --no-deps {REQUIRED_PACKAGE}=={min(others.values())}"
    )
