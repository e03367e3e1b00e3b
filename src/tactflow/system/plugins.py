"""Plug-ins: entry points of installed packages."""

from __future__ import annotations

import functools
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def plugins(group: str) -> Sequence[EntryPoint]:
    """The entry points of a group such as `tactflow.sources`.

    The first call reads the metadata of all installed packages, which takes some milliseconds.
    """
    return _installed(group, tuple(sys.path))


@functools.cache
def _installed(group: str, path: tuple[str, ...]) -> Sequence[EntryPoint]:
    # Imported here, because it takes 40 ms.
    from importlib import metadata

    points = metadata.entry_points(group=group) if path else ()
    # A distribution found twice (an editable install and its build folder) is one plug-in.
    return list({(point.name, point.value): point for point in points}.values())
