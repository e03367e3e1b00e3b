"""Questions that are answered in the terminal or on the live page, beside the picture that they are about."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, Final

from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.ports import Image
from tactflow.sources import FrameReader
from tactflow.view.address import address, bind
from tactflow.view.compact import encode_packet
from tactflow.view.hub import Hub
from tactflow.view.server import Server

HOST: Final = "127.0.0.1"
SENSOR: Final = "setup"
"""Name of the tab of the page."""
SHOW_SECONDS: Final = 1 / 30
"""Shortest interval between frames on the page, s."""

Choices = Mapping[str, str]
"""Answer -> its label; the first is the proposal."""


class Questions:
    """Asks, shows pictures, and takes the first answer from the terminal or a page.

    port : of the page, the next free one if it is taken; None without a page: every proposal is taken.
    say : shows a line in the terminal.

    url : of the page, None if there is none.
    """

    def __init__(self, port: int | None, say: Callable[[str], None]) -> None:
        self._say = say
        self._answers: SimpleQueue[tuple[int | None, str]] = SimpleQueue()
        self._number, self._choices = 0, dict[str, str]()
        self._state: dict[str, Any] = {"now": "", "choices": [], "notes": ""}
        self._server: Server | None = None
        self._shown: Result | None = None
        self._due, self._count = 0.0, 0
        self._reading = False
        self.url: str | None = None
        self.port = port
        self.unattended = port is None
        if port is not None:
            self._serve(port)
            self._reading = True
            threading.Thread(target=self._read_terminal, name="tactflow-terminal", daemon=True).start()

    def _serve(self, port: int) -> None:
        try:
            listener = bind(HOST, port)
        except OSError as error:
            self._say(f"no page: {HOST}:{port} cannot be served ({error}); answer here")
            return
        self.port = listener.getsockname()[1]
        self._hub = Hub(None, SENSOR, answers={"answer": self._take})
        self._server = Server(self._hub, listener, HOST, None)
        self._server.start()
        self.url = address(HOST, self.port)

    def _take(self, value: Any) -> None:
        """An answer of a page, with the number of its question: a late one must not answer the next."""
        number, answer = value
        self._answers.put((int(number), str(answer)))

    def _read_terminal(self) -> None:
        for line in sys.stdin or ():
            self._answers.put((None, line.strip()))
        self._reading = False

    def close(self) -> None:
        """Serve the page no more."""
        if self._server is not None:
            self._server.close()

    def begin(
        self, text: str, choices: Choices | None = None, notes: Sequence[str] = (), sides: bool = False
    ) -> None:
        """Ask. notes : lines above. sides : the choices are edges of the picture, clockwise from the top."""
        self._number += 1
        self._choices = dict(choices or {})
        places = ("top", "right", "bottom", "left") if sides else ()
        self._state = {
            "now": text,
            "number": self._number,
            "notes": "\n".join(notes),
            "choices": [
                {"value": value, "label": label, "at": places[index] if sides else None}
                for index, (value, label) in enumerate(self._choices.items())
            ],
        }
        numbered = [f"{number} {label}" for number, label in enumerate(self._choices.values(), 1)]
        self._say("\n".join([*notes, text, *([] if self.unattended else numbered)]))
        self._due = 0.0
        if self._shown is not None:
            self.show(self._shown)

    def poll(self) -> str | None:
        """The answer to the question, or None as long as there is none."""
        try:
            number, text = self._answers.get_nowait()
        except Empty:
            if self.url is None and not self._reading:
                raise ConfigError(
                    "nobody can answer, as standard input has ended and there is no page; give --yes"
                ) from None
            return None
        values = list(self._choices)
        if number is None and text.isdecimal() and 0 < int(text) <= len(values):
            return values[int(text) - 1]
        if number is None and not text:
            return values[0]
        if text in self._choices and number in (None, self._number):
            return text
        if number is None:
            self._say(f"required a number from 1 to {len(values)}; Enter is 1")
        return None

    def ask(
        self,
        text: str,
        choices: Choices,
        reader: FrameReader | None = None,
        notes: Sequence[str] = (),
        *,
        sides: bool = False,
    ) -> str:
        """Ask, and show the frames of a live reader, or the last picture, until there is an answer.

        Raises
        ------
        SourceError : the reader ends.
        ConfigError : nobody can answer.
        """
        if self.unattended:
            return next(iter(choices))
        self.begin(text, choices, notes, sides)
        while (answer := self.poll()) is None:
            if reader is None:
                time.sleep(SHOW_SECONDS)
                if self._shown is not None:
                    self.show(self._shown)
            elif (arrival := reader.read_arrival()) is not None:
                self.show(arrival.image)
            else:
                raise SourceError(f"{reader.name}: the pictures ended")
        return answer

    def show(self, picture: Result | Image) -> None:
        """Show a picture, or a result with what was found, on the pages that are ready for one."""
        if not isinstance(picture, Result):
            self._count += 1
            picture = Result(Frame(SENSOR, self._count, time.time(), picture))
        elif picture.sensor != SENSOR:
            picture = Result(replace(picture.frame, sensor=SENSOR), picture)
        self._shown = picture
        now = time.perf_counter()
        if self._server is None or not self._hub.wanted or now < self._due:
            return
        self._due = now + SHOW_SECONDS
        packet = encode_packet(
            picture, None, (), latency_ms=-1.0, guide=self._state, quality=85, max_size=1280
        )
        self._hub.publish(*packet, 0.0)
