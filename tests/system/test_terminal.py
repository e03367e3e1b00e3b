"""Progress where there is a terminal, and where there is none."""

from __future__ import annotations

import pytest

from tactflow.system import terminal
from tactflow.system.terminal import progress_bar


def test_without_a_terminal_a_long_command_says_now_and_then_where_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 0.0
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now)
    with progress_bar("stress", lines=True) as update:
        update(description="first", completed=1, total=4)
        now = 11.0
        update(description="second\nline")
        update(description="third", completed=2, total=4)
        now = 22.0
        update(description="fourth")
    assert capsys.readouterr().err.splitlines() == [
        "tactflow: 11 s, 1 of 4 done: second",
        "  line",
        "tactflow: 22 s, 2 of 4 done: fourth",
    ]


def test_a_command_that_prints_its_own_lines_stays_silent_without_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with progress_bar("run") as update:
        update(description="frames", completed=1, total=4)
    with progress_bar("quiet", shown=False, lines=True) as update:
        update(description="frames", completed=1, total=4)
    assert capsys.readouterr().err == ""
