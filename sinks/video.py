"""Video: annotated frames as a video file."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from tactflow.drawing.film import CODECS, Film
from tactflow.engine.frame import Tick
from tactflow.outputs import OutputParams, OutputSink
from tactflow.ports import Picture
from tactflow.system.files import expanded


class Video(OutputSink):
    """Writes annotated frames to a video file; its extension chooses the codec.

    The file plays at the rate of capture: without `fps`, that is the median rate of the first frames. Players
    show frames at a constant rate, so frames dropped by a live run shorten the film.

    >>> import tactflow
    >>> settings = {"sinks": {"video": {"path": "a.avi"}}}
    >>> result = tactflow.run(source="sim:press", settings=settings, max_frames=3)
    >>> tactflow.run("markerless", source="a.avi", settings={"sinks": {}}).stats["frames"]
    3
    """

    class Params(OutputParams):
        """Destination and rate."""

        path: str = Field(
            "annotated.avi",
            description="file: .avi (MJPG), .mkv, .mp4, .m4v, .mov (MPEG-4); relative to the current "
            "directory. An .avi survives a killed process, an .mp4 does not",
        )
        fps: float | None = Field(
            None, gt=0, le=1000, description="rate of the file, frames per second; default: as captured"
        )

        @model_validator(mode="after")
        def _known_extension(self) -> Video.Params:
            if Path(self.path).suffix.lower() not in CODECS:
                raise ValueError(f"required a path that ends in {', '.join(CODECS)}, got {self.path!r}")
            return self

    def __init__(self, params: Params) -> None:
        """Prepare; nothing is opened yet."""
        super().__init__(params)
        self._film: Film | None = None

    def open(self) -> None:
        """Create the file and its folder.

        Raises StageError if the file exists, another run is writing to it, it is a pipe or device, or it
        cannot be written.
        """
        p = self.params
        self._film = Film(expanded(p.path), fps=p.fps, overwrite=p.overwrite)

    def begin(self) -> None:
        """Empty the file, if it is replaced."""
        if self._film is not None:
            self._film.begin()

    def counters(self) -> dict[str, int]:
        """frames : written so far."""
        return {"frames": 0 if self._film is None else self._film.frames}

    def write(self, tick: Tick, annotated: Picture) -> None:
        """Add one frame.

        Raises StageError if the picture changes its size, or the disk is nearly full. The film then ends with
        the frame before.
        """
        if self._film is not None:
            self._film.add(tick.frame.t, annotated)

    def close(self) -> None:
        """Finish the file.

        Raises StageError if frames are missing, because of a full disk, a limit on the size of files, or
        another program that removed the file.
        """
        if self._film is not None:
            self._film.close()
