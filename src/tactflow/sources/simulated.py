"""The simulated sensor as a source."""

from __future__ import annotations

from collections.abc import Iterator

from tactflow.engine.errors import SourceError
from tactflow.sources.base import BgrImage, FrameReader


class Simulated(FrameReader):
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

    def __init__(self, spec: str) -> None:
        from tactflow.sim import open_scene

        super().__init__(spec)
        try:
            self._scene = open_scene(spec.removeprefix("sim:"))
        except ValueError as error:
            raise SourceError(f"{spec}: {error}") from error
        self.fps = self._scene.fps
        self.size = self._scene.size
        self.total = len(self._scene)
        self.description = f"{spec}, {self.total} frames at {self.fps:g} fps"

    def _frames(self) -> Iterator[tuple[BgrImage, float]]:
        for index in range(len(self._scene)):
            yield self._scene.frame(index), index / self._scene.fps
