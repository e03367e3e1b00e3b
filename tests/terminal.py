"""The command line, called in this process."""

from __future__ import annotations

import pytest

from tactflow.cli.main import main


class Terminal:
    """Calls `tactflow`. out, err : what the last call printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.out = self.err = ""

    def __call__(self, *words: str) -> int:
        """Call the program with these words; returns its exit code."""
        self._capsys.readouterr()
        code = main(words)
        self.out, self.err = self._capsys.readouterr()
        return code
