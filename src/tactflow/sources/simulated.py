"""The simulated sensor as a source."""

from __future__ import annotations

from tactflow.engine.errors import SourceError
from tactflow.sources.base import Source


def open_simulated(spec: str) -> Source:
    """Open `sim:NAME` or `sim:NAME?frames=300&seed=7`.

    Raises
    ------
    SourceError
        If there is no scene of that name, or it does not have that parameter.
    """
    from tactflow.sim import open_scene

    try:
        return open_scene(spec.removeprefix("sim:"))
    except ValueError as error:
        raise SourceError(f"{spec}: {error}") from error
