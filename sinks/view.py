"""View: the run, live, on a page in the browser."""

from __future__ import annotations

import dataclasses
import logging
import threading
import time
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import orjson
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.control import Control
from tactflow.engine.frame import Tick
from tactflow.jpeg import encode_jpeg
from tactflow.message import STATUS_NAMES, Results, encode_message
from tactflow.ports import Image, Valid
from tactflow.view.address import Neighbours, address, bind, is_loopback
from tactflow.vision.draw import dimmed
from tactflow.vision.types import Markers

if TYPE_CHECKING:
    from tactflow.view.hub import Hub
    from tactflow.view.server import Server

log = logging.getLogger("tactflow")

STATUS_LETTERS = np.array([ord(name[0]) for name in STATUS_NAMES], np.uint8)
"""The first letter of the word for each value of `MarkerStatus`."""


class View(Sink):
    """Serves a page that draws the results over the processed frame, and can pause and end the run.

    While no page is open, or none is ready for another frame, nothing is wanted and nothing is encoded. A
    view that cannot be shown is reported once and never stops a run.
    """

    threaded = True
    when_live = "latest"
    observer = True

    class Params(StageParams):
        """Where the page is served, and how much it shows."""

        host: str = Field(
            "127.0.0.1",
            min_length=1,
            description="address of this machine to serve on; any but loopback needs a token, and sends it "
            "unencrypted (from afar, ssh -L 8780:localhost:8780 is safer)",
        )
        port: int = Field(
            8780, ge=0, le=65535, description="port; the next free one where it is taken; 0 picks any"
        )
        token: str | None = Field(
            None,
            min_length=16,
            pattern=r"^[A-Za-z0-9_.~-]+$",
            description="a secret that a page must show, as in http://HOST:PORT/?token=...",
        )
        max_fps: float = Field(
            30.0, gt=0, le=240, description="frames shown a second; more is smoother and costs more"
        )
        quality: int = Field(
            85, ge=1, le=100, description="of the JPEG pictures; higher is sharper and larger"
        )
        max_size: int = Field(
            1280, ge=64, description="larger pictures are reduced to this length of their longer side, px"
        )
        neighbours: str | None = Field(
            None,
            description="folder in which the views of a run of several sensors tell each other where they "
            "are; such a run sets it by itself",
        )
        open_browser: bool = Field(False, description="open the page in the desktop's browser")

        @model_validator(mode="after")
        def _guarded(self) -> View.Params:
            if self.token is None and not is_loopback(self.host):
                raise ValueError(
                    f"host {self.host} can be reached from other machines, so a token is required: set token "
                    "to 16 or more letters and digits that nobody guesses, or host to 127.0.0.1"
                )
            return self

    def __init__(self, params: Params, sensor: str = "main", control: Control | None = None) -> None:
        """Prepare; nothing is served yet.

        Parameters
        ----------
        sensor : names the tab.
        control : handle on the run, for the statistics and the buttons.
        """
        super().__init__(params)
        self._sensor = sensor
        self._control = control
        self._hub: Hub | None = None
        self._server: Server | None = None
        self._neighbours = None if params.neighbours is None else Neighbours(Path(params.neighbours), sensor)
        self._interval = 1.0 / params.max_fps
        self._due = float("-inf")
        self._encoded = 0

    @classmethod
    def among(cls, params: View.Params, folder: Path) -> View.Params:
        """Its page shows a tab for each of the others."""
        return params.changed(neighbours=str(folder))

    def open(self) -> None:
        """Serve the page; afterwards `description` is its address, or None if it cannot be served."""
        p = self.params
        try:
            from tactflow.view.hub import Hub
            from tactflow.view.server import Server

            listener = bind(p.host, p.port)
            if self._neighbours is not None:
                self._neighbours.announce(listener.getsockname()[1])
        except (ImportError, OSError, UnicodeError) as error:
            log.warning("view: not shown, because %s:%d cannot be served: %s", p.host, p.port, error)
            return
        port = listener.getsockname()[1]
        if p.port not in (0, port) and self._neighbours is None:
            log.warning("view: port %d is taken (by another run?), using %d", p.port, port)
        self._hub = Hub(self._control, self._sensor, self._neighbours or dict)
        self._server = Server(self._hub, listener, p.host, p.token)
        self._server.start()
        self.description = address(p.host, port)
        with_token = self.description + (f"?token={p.token}" if p.token else "")
        log.info("view: %s", with_token)
        if p.open_browser:
            # It may take its time, or wait for the browser to end.
            threading.Thread(target=webbrowser.open, args=(with_token,), daemon=True).start()

    def wants(self) -> bool:
        """Whether a page is ready for another frame. From any thread; takes about 0.2 us."""
        hub = self._hub
        return hub is not None and (hub.owed or (hub.wanted and time.perf_counter() >= self._due))

    def counters(self) -> dict[str, int]:
        """encoded : pictures made; and those of `Hub.counters`."""
        return {"encoded": self._encoded} | ({} if self._hub is None else self._hub.counters())

    def write(self, tick: Tick, results: Results, valid: Valid | None = None) -> None:
        """Send the plain picture and the result message; the page draws one over the other.

        Where no gel is, the picture is darker.

        Browsers take in a message a kilobyte at a time, and each costs a switch between processes. So what is
        only drawn comes in tenths of a pixel: the hull, and the markers, which stand beside the message.
        """
        # What was wanted a moment ago may have become too much meanwhile.
        if self._hub is None or not self.wants():
            return
        now = time.perf_counter()
        # Counted from when this one was due, so that an uneven source does not lower the rate.
        self._due = max(self._due, now - self._interval / 2) + self._interval
        frame = tick.frame
        contact, markers = results.contact, results.markers
        if contact is not None:
            contact = dataclasses.replace(contact, hull=np.round(contact.hull, 1), separate=())
        message = encode_message(tick, results._replace(contact=contact, markers=None), detail=True)
        image = frame.image if results.image is None else results.image
        jpeg = self._encode(image if valid is None else dimmed(image, valid))
        latency = (now - frame.captured) * 1000 if frame.captured else -1.0
        header = b'{"latency_ms":%.3f,"epoch":%d,"message":%b,"markers":%b' % (
            *(latency, frame.epoch, message),
            b"null" if markers is None else _compact(markers),
        )
        self._hub.publish(header, jpeg, frame.captured)

    def _encode(self, image: Image) -> bytes:
        height, width = image.shape[:2]
        factor = self.params.max_size / max(height, width)
        if factor < 1:
            size = (max(1, round(width * factor)), max(1, round(height * factor)))
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        jpeg = encode_jpeg(image, self.params.quality)
        self._encoded += 1
        return jpeg

    def close(self) -> None:
        """Tell the pages that the run has ended, and serve no more."""
        server, self._server = self._server, None
        if server is None:
            return
        if self._neighbours is not None:
            self._neighbours.leave()
        server.close()


def _compact(markers: Markers) -> bytes:
    """The markers as JSON, a fifth of what they take in the message: x0, y0, x1, ... in tenths of a pixel,
    and a string with the first letter of each status."""

    def tenths(points: NDArray[np.float64]) -> NDArray[np.int32]:
        return np.rint(points * 10).astype(np.int32).ravel()

    return orjson.dumps(
        {
            "origin": tenths(markers.origin),
            "position": tenths(markers.position),
            "status": STATUS_LETTERS[markers.status].tobytes().decode(),
        },
        option=orjson.OPT_SERIALIZE_NUMPY,
    )
