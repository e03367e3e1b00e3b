"""The open pages of the live view, and flow control for each of them.

Each page has credit for one frame: the next one is sent only after the page has acknowledged drawing the
last. So a slow page gets fewer frames instead of old ones and does not slow down others. While no page has
credit, the view requests no frames.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import orjson
from websockets.asyncio.server import ServerConnection

from tactflow.engine.control import Control
from tactflow.network.commands import Commands, RefusedError

log = logging.getLogger("tactflow")

STATS_SECONDS = 0.5
"""Interval at which pages receive the statistics of the run, s."""


class Packet(NamedTuple):
    """An encoded frame.

    Attributes
    ----------
    number : counts from 1.
    """

    number: int
    data: bytes


@dataclass(eq=False, slots=True)
class Page:
    """State of one open page.

    Attributes
    ----------
    credit : whether the next frame may be sent.
    sent : number of the last frame sent.
    texts : unsent messages, only the newest of each kind, which bounds the queue of a page that does not
        read.
    wake : set when there is something to send.
    ended : the run is over.
    """

    socket: ServerConnection
    credit: bool = True
    sent: int = 0
    texts: dict[str, str] = field(default_factory=dict)
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    ended: bool = False

    def post(self, kind: str, text: str) -> None:
        """Queue a text message, replacing an unsent one of the same kind."""
        self.texts[kind] = text
        self.wake.set()


class Hub:
    """The open pages.

    `publish`, `wanted` and `counters` may be used from any thread, the rest in the server's event loop.

    Parameters
    ----------
    control : handle on the run; None disables commands.
    sensor : name of the sensor.
    neighbours : returns sensor name -> port of the other sensors' pages.
    answers : further command -> what it calls with its value, of a guided session.
    """

    def __init__(
        self,
        control: Control | None,
        sensor: str,
        neighbours: Callable[[], Mapping[str, int]] = dict,
        answers: Mapping[str, Callable[[Any], Any]] | None = None,
    ) -> None:
        self.control = control
        self._commands = Commands(control)
        self.sensor = sensor
        self.neighbours = neighbours
        self.run_id = secrets.token_hex(8)
        self.wanted = False
        """Whether a page has credit."""
        self.pages: set[Page] = set()
        self.loop: asyncio.AbstractEventLoop | None = None
        """The event loop that serves the pages."""
        self._latest: Packet | None = None
        self._number = 0
        self._sent = 0
        self._end: str | None = None
        self._answers = answers or {}

    # -- from other threads -------------------------------------------------------------------------------

    def publish(self, header: bytes, pixels: bytes) -> None:
        """Offer a frame to every page; never blocks.

        Parameters
        ----------
        header : JSON object that describes the frame, without its closing brace.
        pixels : heights of a surface, if the header describes one, followed by the JPEG picture.
        """
        self._number += 1
        header = header + b',"number":%d}' % self._number
        # A little-endian length, the JSON header, the heights and the picture.
        data = struct.pack("<I", len(header)) + header + pixels
        packet = Packet(self._number, data)
        if self.loop is not None and not self.loop.is_closed():
            self.loop.call_soon_threadsafe(self._take, packet)

    def counters(self) -> dict[str, int]:
        """Statistics: open `pages`, and frames `sent` to all pages."""
        return {"pages": len(self.pages), "sent": self._sent}

    # -- the life of a page -------------------------------------------------------------------------------

    async def serve(self, socket: ServerConnection) -> None:
        """Serve a page until it disconnects or the run ends."""
        page = Page(socket)
        page.post("hello", _text(type="hello", run=self.run_id, sensors=[self.sensor]))
        page.post("state", self.state())
        if not (self.pages or self._paused):
            # Made when a page was last open.
            self._latest = None
        self.pages.add(page)
        self._recount()
        page.wake.set()
        sender = asyncio.create_task(self._send(page))
        reader = asyncio.create_task(self._read(page))
        try:
            await asyncio.wait((sender, reader), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.pages.discard(page)
            self._recount()
            for task in (sender, reader):
                task.cancel()
            await asyncio.gather(sender, reader, return_exceptions=True)

    async def report(self) -> None:
        """Send the statistics of the run periodically while pages are open."""
        while True:
            self.post_stats()
            await asyncio.sleep(STATS_SECONDS)

    def end(self) -> None:
        """Send every page the reason for the end of the run, and disconnect it."""
        # Without a run, as for questions, the page only ends.
        self._end = str(self._commands.snapshot().get("end", "eos"))
        for page in self.pages:
            page.ended = True
        self.post_stats()

    def post_state(self) -> None:
        """Send the current state to every page."""
        text = self.state()
        for page in self.pages:
            page.post("state", text)

    def post_stats(self) -> None:
        """Send statistics and state to every page."""
        if not self.pages:
            return
        snapshot = self._commands.snapshot()
        state = self.state()
        for page in self.pages:
            page.post("stats", _text(type="stats", sensor=self.sensor, run=snapshot))
            page.post("state", state)

    def state(self) -> str:
        """State message: status of the run, and for each button null or why it is disabled."""
        control = self.control
        source = None if control is None else control.source
        now = self._commands.state()
        paused, condition = now["paused"], now["source"]
        return _text(
            type="state",
            sensor=self.sensor,
            paused=paused,
            recording=now["recording"],
            end=self._end,
            neighbours=self.neighbours(),
            source={
                "description": None if source is None else source.description,
                "live": source is not None and source.live,
                "total": None if source is None else source.total,
                "state": "paused" if paused and condition == "running" else condition,
            },
            refused={name: self._refusal(name) for name in (*Commands.NAMES, *self._answers)},
        )

    # -- inside the loop ----------------------------------------------------------------------------------

    def _take(self, packet: Packet) -> None:
        self._latest = packet
        for page in self.pages:
            if page.credit:
                page.wake.set()

    @property
    def _paused(self) -> bool:
        return self.control is not None and self.control.paused

    def _recount(self) -> None:
        self.wanted = any(page.credit for page in self.pages)

    async def _send(self, page: Page) -> None:
        while True:
            await page.wake.wait()
            page.wake.clear()
            while page.texts:
                kind = next(iter(page.texts))
                await page.socket.send(page.texts.pop(kind))
            if page.ended:
                await page.socket.close(1001, "the run has ended")
                return
            packet = self._latest
            if page.credit and packet is not None and packet.number > page.sent:
                page.credit = False
                page.sent = packet.number
                self._sent += 1
                self._recount()
                await page.socket.send(packet.data)

    async def _read(self, page: Page) -> None:
        while True:
            try:
                message = orjson.loads(await page.socket.recv())
            except orjson.JSONDecodeError:
                message = None
            if not isinstance(message, dict):
                await page.socket.close(1008, "required a JSON object")
                return
            if "ack" not in message:
                await self._command(page, message)
            elif message["ack"] == page.sent:
                page.credit = True
                self._recount()
                page.wake.set()

    async def _command(self, page: Page, message: Mapping[str, Any]) -> None:
        name = message.get("do")
        try:
            if name not in [*Commands.NAMES, *self._answers]:
                raise RefusedError(f"there is no command {name!r}")
            refusal = self._refusal(name)
            if refusal is not None:
                raise RefusedError(refusal)
            value = message.get("value")
            # Starting or ending a recording may access the disk.
            if name in self._answers:
                await asyncio.to_thread(self._answers[name], value)
            else:
                await asyncio.to_thread(self._commands.execute, name, value is True)
        except Exception as error:
            if not isinstance(error, RefusedError):
                log.warning("view: %s failed: %s: %s", name, type(error).__name__, error)
            page.post("note", _text(type="note", text=str(error) or type(error).__name__))
        self.post_state()

    def _refusal(self, name: str) -> str | None:
        """Why a command is unavailable, or None."""
        if self._end is not None:
            return "the run has ended"
        return None if name in self._answers else self._commands.refusal(name)


def _text(**fields: Any) -> str:
    return orjson.dumps(fields, option=orjson.OPT_NON_STR_KEYS | orjson.OPT_SERIALIZE_NUMPY).decode()
