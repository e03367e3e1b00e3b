"""The command of this plug-in, as `pyproject.toml` declares it in the group `tactflow.commands`."""

from __future__ import annotations

from typing import Final

from tactflow.cli.command import Command

MAP: Final = Command(
    "merge what a recording shows of one object into a surface in mm, with its errors",
    "tactflow.plugins.map.command",
)
