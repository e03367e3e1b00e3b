"""Questions that are answered in the terminal or on the live page, next to their picture."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any, Final

from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.ports import Image
from tactflow.sources import FrameReader
from tactflow.system.clock import SYSTEM
from tactflow.view.address import address, bind
from tactflow.view.compact import encode_packet
from tactflow.view.hub import Hub
from tactflow.view.server import Server

HOST: Final = "127.0.0.1"
SENSOR: Final = "setup"
"""Name of the tab of the page."""
MIN_FRAME_INTERVAL_S: Final = 1 / 30
"""Shortest interval between frames on the page, s."""

Choices = Mapping[str, str]
"""Answer -> its label; the first is the proposal."""


class Questions:
    """Asks, shows pictures, and takes the first answer from the terminal or a page.

    Parameters
    ----------
    port : of the page, the next free one if it is taken; None: nobody is asked, every proposal is taken.
    say : shows lines in the terminal.

    Attributes
    ----------
    url : of the page, None if there is none.
    reader : live source that is shown while an answer is waited for; None shows the last picture.
    """

    def __init__(self, port: int | None, say: Callable[[str], None]) -> None:
        self.port = port
        self.unattended = port is None
        self.url: str | None = None
        self.reader: FrameReader | None = None
        self._say = say
        self._answers: SimpleQueue[tuple[int | None, str]] = SimpleQueue()
        self._choices: Choices = {}
        self._state: dict[str, Any] = {"number": 0}
        self._shown: Result | None = None
        self._due = 0.0
        self._hub = Hub(None, SENSOR, answers={"answer": self._take})
        self._server: Server | None = None
        self._terminal = threading.Thread(target=self._read_terminal, name="tactflow-terminal", daemon=True)
        if port is not None:
            self._serve(port)
            self._terminal.start()

    def _serve(self, port: int) -> None:
        try:
            listener = bind(HOST, port)
        except OSError as error:
            self._say(f"no page, because {HOST}:{port} cannot be served ({error}); answer here")
            return
        self.port = listener.getsockname()[1]
        self._server = Server(self._hub, listener, HOST, None)
        self._server.start()
        self.url = address(HOST, self.port)
        self._say(f"answer here, or on the page: {self.url}")

    def _take(self, value: Any) -> None:
        """An answer of a page, with the number of its question: a late one must not answer the next."""
        number, answer = value
        self._answers.put((int(number), str(answer)))

    def _read_terminal(self) -> None:
        # Without `sys.stdin`: a waiting thread would hold its lock at the end of the program.
        with suppress(OSError, ValueError):
            while text := os.read(sys.stdin.fileno(), 4096):
                for line in text.decode(errors="replace").splitlines():
                    self._answers.put((None, line.strip()))

    def close(self) -> None:
        """Stop serving the page."""
        if self._server is not None:
            self._server.close()

    def begin(self, text: str, choices: Choices | None = None, *, notes: Sequence[str] = ()) -> None:
        """Ask. notes : lines above."""
        self._choices = choices or {}
        self._state = {
            "now": text,
            "number": self._state["number"] + 1,
            "notes": "\n".join(notes),
            "choices": [{"value": value, "label": label} for value, label in self._choices.items()],
        }
        numbered = [f"{number} {label}" for number, label in enumerate(self._choices.values(), 1)]
        self._say("\n".join([*notes, text, *([] if self.unattended else numbered)]))
        self._due = 0.0
        if self._shown is not None:
            self.show(self._shown)

    def poll(self) -> str | None:
        """The answer to the question; None before there is one.

        Raises ConfigError if there is neither a page nor a terminal.
        """
        try:
            number, text = self._answers.get_nowait()
        except Empty:
            if self.url is None and not self._terminal.is_alive():
                raise ConfigError(
                    "nobody can answer, as standard input has ended and there is no page; for a recording, "
                    "--yes accepts every proposal"
                ) from None
            return None
        if number is not None:
            return text if number == self._state["number"] and text in self._choices else None
        answers = dict(enumerate(self._choices, 1))
        answer = answers.get(int(text or 1) if text.isdecimal() or not text else 0)
        if answer is None and answers:
            self._say(f"required a number from 1 to {len(answers)}; Enter is 1")
        return answer

    def ask(self, text: str, choices: Choices, *, notes: Sequence[str] = (), still: bool = False) -> str:
        """Ask, and show frames until there is an answer. still : show the last picture instead.

        Raises
        ------
        SourceError : the reader ends.
        ConfigError : nobody can answer.
        """
        if self.unattended:
            return next(iter(choices))
        self.begin(text, choices, notes=notes)
        while (answer := self.poll()) is None:
            if still or self.reader is None:
                time.sleep(MIN_FRAME_INTERVAL_S)
                if self._shown is not None:
                    self.show(self._shown)
            elif (arrival := self.reader.read_arrival()) is not None:
                self.show(arrival.image)
            else:
                raise SourceError(f"{self.reader.name}: the pictures ended")
        return answer

    def show(self, picture: Result | Image) -> None:
        """Show a picture, or a result with what was found, on the pages that are ready for one."""
        if isinstance(picture, Result):
            self._shown = Result(replace(picture.frame, sensor=SENSOR), picture)
        else:
            self._shown = Result(Frame(SENSOR, 0, SYSTEM.unix(), picture))
        now = SYSTEM.now()
        if not self._hub.wanted or now < self._due:
            return
        self._due = now + MIN_FRAME_INTERVAL_S
        packet = encode_packet(
            self._shown, None, latency_ms=-1.0, guide=self._state, quality=85, max_size=1280
        )
        self._hub.publish(*packet)
