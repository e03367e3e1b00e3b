"""View: the live page in a browser."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from pydantic import Field, model_validator

from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.control import Control
from tactflow.message.result import Result
from tactflow.network.address import is_loopback
from tactflow.ports import Valid
from tactflow.view.address import Neighbours, address, bind
from tactflow.view.compact import encode_packet

if TYPE_CHECKING:
    from tactflow.view.hub import Hub
    from tactflow.view.server import Server

log = logging.getLogger("tactflow")


class GuidedSession(Protocol):
    """Tells its user what to do next."""

    @property
    def state(self) -> Mapping[str, Any]:
        """For the page; replaced as a whole, so that any thread may read it."""


class View(Sink):
    """Serves a page that draws the results over the processed frame, and can pause and end the run.

    While no open page is ready for another frame, none is requested or encoded. A view that cannot be served
    is reported once and never stops a run.

    >>> import tactflow
    >>> settings = {"sinks": {"view": {"port": 0}}}
    >>> tactflow.run(source="sim:press", settings=settings, max_frames=3).stats["frames"]
    3
    """

    threaded = True
    when_live = "latest"
    observer = True

    class Params(StageParams):
        """Address of the page, and amount of data."""

        host: str = Field(
            "127.0.0.1",
            min_length=1,
            description="address of this machine to serve on; any but loopback needs a token, and sends it "
            "unencrypted (ssh -L 8780:localhost:8780 is safer)",
        )
        port: int = Field(8780, ge=0, le=65535, description="port, or the next free one; 0: any")
        token: str | None = Field(
            None,
            min_length=16,
            pattern=r"^[A-Za-z0-9_.~-]+$",
            description="a secret required of every page, as in http://HOST:PORT/?token=...",
        )
        max_fps: float = Field(30.0, gt=0, le=240, description="maximum number of frames per second")
        quality: int = Field(85, ge=1, le=100, description="of the pictures; higher is sharper and larger")
        max_size: int = Field(1280, ge=64, description="longer side of pictures, px; larger ones are reduced")
        neighbours: str | None = Field(None, description="folder shared by several sensors; set by their run")

        @model_validator(mode="after")
        def _guarded(self) -> View.Params:
            if self.token is None and not is_loopback(self.host):
                raise ValueError(
                    f"host {self.host} can be reached from other machines, so a token is required: set token "
                    "to 16 or more random letters and digits, or host to 127.0.0.1"
                )
            return self

    def __init__(
        self,
        params: Params,
        sensor: str = "main",
        control: Control | None = None,
        session: GuidedSession | None = None,
    ) -> None:
        """Prepare; nothing is served yet.

        sensor : names the tab. control : handle on the run, for the statistics and the buttons. session :
        shown by the page, such as the presses of a calibration.
        """
        super().__init__(params)
        self._session = session
        self._sensor = sensor
        self._control = control
        self._hub: Hub | None = None
        self._server: Server | None = None
        self._neighbours = None if params.neighbours is None else Neighbours(Path(params.neighbours), sensor)
        self._due = float("-inf")
        self._encoded = 0

    def open(self) -> None:
        """Serve the page; afterwards `description` is its address, or None if it cannot be served."""
        p = self.params
        try:
            listener = bind(p.host, p.port)
            if self._neighbours is not None:
                self._neighbours.announce(listener.getsockname()[1])
        except (OSError, UnicodeError) as error:
            log.warning("view: not shown, because %s:%d cannot be served: %s", p.host, p.port, error)
            return
        port = listener.getsockname()[1]
        if p.port not in (0, port) and self._neighbours is None:
            log.warning("view: port %d is taken (by another run?), using %d", p.port, port)
        # Not at the top: its packages take a tenth of a second, and most commands serve no page.
        from tactflow.view.hub import Hub
        from tactflow.view.server import Server

        self._hub = Hub(self._control, self._sensor, self._neighbours or dict)
        self._server = Server(self._hub, listener, p.host, p.token)
        self._server.start()
        self.description = address(p.host, port)
        log.info("view: %s%s", self.description, f"?token={p.token}" if p.token else "")

    def wants(self) -> bool:
        """Whether a page is ready for another frame. Thread-safe; takes about 0.2 us."""
        hub = self._hub
        if hub is None:
            return False
        # A frame of a paused run is a single step, which every page must show.
        stepped = bool(hub.pages) and self._control is not None and self._control.paused
        return stepped or (hub.wanted and time.perf_counter() >= self._due)

    def counters(self) -> dict[str, int]:
        """encoded : encoded pictures; and those of `Hub.counters`."""
        return {"encoded": self._encoded} | ({} if self._hub is None else self._hub.counters())

    def write(self, result: Result, valid: Valid | None = None) -> None:
        """Send the picture and the results, which the page draws over it."""
        hub, p = self._hub, self.params
        # The pages may not be ready any more.
        if hub is None or not self.wants():
            return
        now, interval = time.perf_counter(), 1.0 / p.max_fps
        # Counted from when this one was due, so that an uneven source does not lower the rate.
        self._due = max(self._due, now - interval / 2) + interval
        captured = result.frame.captured
        packet = encode_packet(
            result,
            valid,
            latency_ms=(now - captured) * 1000 if captured else -1.0,
            guide=None if self._session is None else self._session.state,
            quality=p.quality,
            max_size=p.max_size,
        )
        self._encoded += 1
        hub.publish(*packet)

    def close(self) -> None:
        """Notify the pages of the end of the run, and stop serving."""
        server, self._server = self._server, None
        if server is None:
            return
        if self._neighbours is not None:
            self._neighbours.leave()
        server.close()
        # The summary at the end of a run must not name the page.
        self.description = None
