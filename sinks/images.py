"""Images: annotated frames as numbered files."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Literal

import cv2
from pydantic import Field

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Tick
from tactflow.outputs import cannot_write, locked_folder
from tactflow.ports import Picture
from tactflow.system.files import expanded

UNFINISHED = ".unfinished"
"""Name of a picture until it is complete."""


class Images(Sink):
    """Writes pictures to `folder/frame-000036.png`, numbered by the frame's `seq`.

    The picture comes from the port `annotated`; `in: {annotated: inpaint.unmarked}` selects another colour
    image. `max_rate` writes fewer frames.

    >>> import tactflow
    >>> settings = {"sinks": {"images": {"folder": "pictures"}}}
    >>> result = tactflow.run(source="sim:press", settings=settings, max_frames=3)
    >>> sorted(path.name for path in Path("pictures").glob("*.png"))
    ['frame-000000.png', 'frame-000001.png', 'frame-000002.png']
    """

    threaded = True

    class Params(StageParams):
        """Destination and format."""

        folder: str = Field("images", min_length=1, description="relative to the current directory; created")
        format: Literal["png", "jpg"] = Field("png", description="png is lossless, jpg is small and fast")
        quality: int = Field(95, ge=1, le=100, description="of a jpg; 100 is the best and largest")
        overwrite: bool = Field(False, description="write into a folder that already holds frames")

        @property
        def refuses_existing(self) -> bool:
            """Whether existing frames are an error."""
            return not self.overwrite

    def __init__(self, params: Params) -> None:
        """Prepare; nothing is written yet."""
        super().__init__(params)
        self._folder = expanded(params.folder)
        self.description = str(self._folder)
        self._lock = ExitStack()
        self._files = 0
        self._options = [cv2.IMWRITE_JPEG_QUALITY, params.quality] if params.format == "jpg" else []

    @classmethod
    def outputs(cls, params: Images.Params) -> Mapping[str, Path]:
        """The folder."""
        return {"folder": expanded(params.folder)}

    def open(self) -> None:
        """Create the folder.

        Raises StageError if it already holds frames and `overwrite` is not set, another run is writing to it,
        or it cannot be created.
        """
        self._lock.enter_context(locked_folder(self._folder))
        present = next(self._folder.glob("frame-*.[pj][np]g"), None)
        if present is not None and not self.params.overwrite:
            raise StageError(
                f"{self._folder}: already holds frames ({present.name}, ...); set overwrite: true or give "
                "another folder"
            )

    def counters(self) -> dict[str, int]:
        """files : written so far."""
        return {"files": self._files}

    def write(self, tick: Tick, annotated: Picture) -> None:
        """Write one file. Raises StageError if it cannot be written."""
        path = self._folder / f"frame-{tick.frame.seq:06d}.{self.params.format}"
        _, data = cv2.imencode(path.suffix, annotated, self._options)
        unfinished = self._folder / UNFINISHED
        try:
            unfinished.write_bytes(data.tobytes())
            unfinished.replace(path)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink()
            kept = f"the {self._files} pictures written before are complete"
            raise cannot_write(path, error, kept) from error
        self._files += 1

    def close(self) -> None:
        """Let other runs have the folder."""
        self._lock.close()
