"""The simulated sensor as a source."""

from __future__ import annotations

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage


class Simulated:
    """A scene of the simulated sensor, rendered frame by frame; frame i is taken at i / fps.

    Parameters
    ----------
    spec : `sim:NAME` or `sim:NAME?frames=300&seed=7`.

    Raises
    ------
    SourceError
        If there is no scene of that name, or it does not have that parameter.

    Examples
    --------
    >>> reader = Simulated("sim:idle?frames=2")
    >>> reader.description
    'sim:idle?frames=2, 2 frames at 60 fps'
    """

    live = False

    def __init__(self, spec: str) -> None:
        from tactflow.sim import open_scene

        try:
            self._scene = open_scene(spec.removeprefix("sim:"))
        except ValueError as error:
            raise SourceError(f"{spec}: {error}") from error
        self._rate = self._scene.fps
        self._index = 0
        self._count = len(self._scene)
        self.fps: float | None = self._rate
        self.size: tuple[int, int] | None = self._scene.size
        self.total: int | None = self._count
        self.description = f"{spec}, {self._count} frames at {self._rate:g} fps"

    def read(self) -> tuple[BgrImage, float] | None:
        """Render the next frame; see `FrameReader.read`."""
        index = self._index
        if index >= self._count:
            return None
        self._index += 1
        return self._scene.frame(index), index / self._rate

    def close(self) -> None:
        """Render no more."""
        self._index = self._count
