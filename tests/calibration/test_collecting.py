"""How a session that collects frames ends."""

from __future__ import annotations

import signal

import pytest

import tactflow
from tactflow.calibration.presses import Press, Session, find_presses


def session_that_gets(*numbers: int) -> Session:
    """An endless session in whose first frame signals come."""
    left = list(numbers)

    def report(_frames: int, _presses: list[Press], _lasts: bool) -> bool:
        while left:
            signal.raise_signal(left.pop(0))
        return False

    return find_presses(tactflow.load(source="sim:ball?frames=1000000"), report)


def test_what_was_found_counts_after_one_signal() -> None:
    assert session_that_gets(signal.SIGINT).frames > 0


def test_a_second_signal_gives_it_up() -> None:
    with pytest.raises(KeyboardInterrupt):
        session_that_gets(signal.SIGINT, signal.SIGTERM)


def test_one_signal_gives_it_up_while_loops_are_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactflow.vision.compiled.is_loading", lambda: True)
    with pytest.raises(KeyboardInterrupt):
        session_that_gets(signal.SIGINT)
