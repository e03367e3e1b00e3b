"""The program in a process of its own."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from pathlib import Path

from tests.clock import PATIENCE


class Program:
    """A command of tactflow that is running, and what it says on standard error."""

    def __init__(self, *words: str, cwd: Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tactflow", *words],
            cwd=cwd,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.errors: list[str] = []
        self._told = threading.Condition()
        self._heard = 0
        self._ended = False
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            with self._told:
                self.errors.append(line)
                self._told.notify_all()
        with self._told:
            self._ended = True
            self._told.notify_all()

    def said(self, pattern: str) -> str:
        """Wait for a further line that has a pattern; returns its first group, or all of it."""
        match: re.Match[str] | None = None

        def found() -> bool:
            nonlocal match
            while match is None and self._heard < len(self.errors):
                match = re.search(pattern, self.errors[self._heard])
                self._heard += 1
            return match is not None or self._ended

        with self._told:
            self._told.wait_for(found, PATIENCE)
        assert match is not None, "".join(self.errors)
        return match[match.re.groups]

    def type(self, text: str) -> None:
        """Write a line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

    def exit_code(self) -> int:
        """Wait for its end."""
        return self.process.wait(PATIENCE)

    def close(self) -> None:
        """End it, if it is still running."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdin, self.process.stderr):
            assert stream is not None
            stream.close()
