"""The tool that runs several sensors of one pipeline file, found by an entry point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol, cast

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.system.plugins import plugins

GROUP = "tactflow.fleet"
"""Group of its entry point, a module with the functions of `Fleet`."""


class Fleet(Protocol):
    """Runs several sensors side by side."""

    def problems(self, pipelines: Mapping[str, Pipeline]) -> Sequence[str]:
        """Error messages for sensors that would write or listen at the same place.

        pipelines : sensor -> its pipeline.
        """

    def run(self, pipelines: Mapping[str, Pipeline], arguments: Mapping[str, Sequence[str]]) -> int:
        """Run every sensor in a process of its own until all have ended; returns the exit code.

        pipelines : sensor -> its pipeline. arguments : sensor -> command line of its process. Raises
        ConfigError if there are `problems`.
        """


def fleet() -> Fleet:
    """The installed tool. Raises ConfigError if there is none."""
    found = plugins(GROUP)
    if not found:
        raise ConfigError(
            f"several sensors are run by a tool of tactflow, which is not installed (there is no entry point "
            f"{GROUP}): pip install tactflow again, or choose one sensor with --sensor"
        )
    return cast("Fleet", found[0].load())
