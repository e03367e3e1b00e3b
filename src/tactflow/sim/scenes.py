"""The named scenes of the simulated sensor: images, and the truth about them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.sim import faults, gel, markers, motion
from tactflow.sim.camera import FPS, SIZE, Camera
from tactflow.sim.picture import Painter
from tactflow.sim.recipes import SCENES
from tactflow.sim.settings import Settings, parse_query
from tactflow.sim.truth import Truth
from tactflow.system.spelling import did_you_mean
from tactflow.vision.geometry import PixelMapping, Preprocessor


def scene_descriptions() -> dict[str, str]:
    """Scene -> one-line description."""
    return {name: recipe.description for name, recipe in SCENES.items()}


def open_scene(spec: str) -> Scene:
    """Open a scene of the simulated sensor.

    spec : NAME or NAME?key=value&key=value, as in `press?frames=300&seed=7&noise=2`. `tactflow sim --list`
        shows the names and the keys.

    Raises
    ------
    ValueError : an unknown name or key, or an invalid value; the message states the valid ones.

    Examples
    --------
    >>> import tactflow
    >>> scene = tactflow.open_scene("press?frames=60&seed=7")
    >>> len(scene), scene.frame(0).shape
    (60, (600, 800, 3))
    """
    name, _, query = spec.partition("?")
    if name not in SCENES:
        raise ValueError(f"simulated sensor: unknown scene {name!r}{did_you_mean(name, sorted(SCENES))}")
    recipe = SCENES[name]
    return Scene(name, recipe.programme, parse_query(query, recipe.settings))


class Scene:
    """A simulated recording with random access to frames; the same spec gives bit-identical frames.

    Parameters
    ----------
    name, settings : of the scene.

    Attributes
    ----------
    size : (width, height), px.
    fps : frames per second.
    camera : maps the gel to the raw frame.
    layout : the markers as printed.
    """

    fps = FPS
    size = SIZE

    def __init__(self, name: str, programme: motion.Programme | None, settings: Settings) -> None:
        self.name = name
        self.settings = settings
        self.camera = Camera(settings.perspective, settings.distortion, settings.aperture)
        self.layout = markers.layout(settings, SIZE)
        self._programme = programme
        self._shapes = tuple(make() for make in (programme.indenters if programme else ()))
        self._painter = Painter(settings, self.camera, self.layout)
        self._vanishing = np.random.default_rng([settings.seed, 0x7661]).random(len(self.layout.rest))

    def __len__(self) -> int:
        return self.settings.frames

    def __repr__(self) -> str:
        return f"<Scene {self.name}, {len(self)} frames>"

    def presses(self, index: int) -> tuple[gel.Press, ...]:
        """The indenters at frame `index`."""
        return self._contact(index)[0]

    def frame(self, index: int) -> NDArray[np.uint8]:
        """Raw frame `index` as the camera delivers it, a new (600, 800, 3) uint8 BGR array."""
        return faults.delivered(index, self.settings, self._rendered)

    def _rendered(self, index: int) -> NDArray[np.uint8]:
        """Raw frame `index`, undamaged."""
        index = self._shown(index)
        pressed, cycle = self._contact(index)
        return self._painter.frame(index, pressed, ~self._hidden(cycle))

    @property
    def delivered(self) -> list[int]:
        """Indices of the frames that the camera does not lose; among them the first and the last one."""
        lost = np.random.default_rng([self.settings.seed, 0x6C6F]).random(len(self)) < self.settings.lost
        return [index for index in range(len(self)) if index in (0, len(self) - 1) or not lost[index]]

    def _shown(self, index: int) -> int:
        """The moment that a picture shows, which is earlier where the camera is late or stands still."""
        middle, frozen = len(self) // 2, self.settings.frozen
        moment = middle - 1 if middle <= index < middle + frozen else index
        return max(moment - self.settings.lag, 0) if 0 <= index < len(self) else index

    def clean(self, index: int) -> NDArray[np.uint8]:
        """Render raw frame `index` without markers, dirt and noise, a new (600, 800, 3) uint8 BGR array."""
        return self._painter.frame(index, self._contact(index)[0], None)

    def truth(self, index: int, mapping: PixelMapping | Preprocessor | None = None) -> Truth:
        """Ground truth of frame `index`.

        It is of the moment of the frame, also where the camera is late.

        mapping : gives the truth in coordinates of the processed frame, with the contact evaluated at its
            pixel centres. None: raw coordinates.
        """
        if isinstance(mapping, Preprocessor):
            mapping = mapping.mapping
        presses, cycle = self._contact(index)
        pixels = mapping or PixelMapping.identity(SIZE)
        return Truth(presses, self.camera, pixels, self.layout.rest, ~self._hidden(cycle))

    def _hidden(self, cycle: int) -> NDArray[np.bool_]:
        """(N,) bool: markers invisible during contact number `cycle` (-1: no contact)."""
        return (self._vanishing < self.settings.vanish) & (cycle >= 0)

    def _contact(self, index: int) -> tuple[tuple[gel.Press, ...], int]:
        """The indenters at frame `index`, and the index of their contact."""
        if not 0 <= index < len(self):
            raise IndexError(f"required a frame in [0, {len(self) - 1}], got {index}")
        if self._programme is None:
            return (), -1
        return motion.presses(
            self._programme, self._shapes, index, self.settings, size=SIZE, pitch=self.layout.pitch
        )
