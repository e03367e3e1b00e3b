"""Real-time priority is asked for as Linux offers it, and a refusal is told in words."""

from __future__ import annotations

import errno
import os
import sys

import pytest

from tactflow.engine.priority import ask_for_realtime

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has these priorities")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, int]]:
    """What the system was asked for: thread, policy, priority."""
    calls: list[tuple[int, int, int]] = []
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda *given: calls.append((*given[:2], given[2].sched_priority))
    )
    return calls


def test_every_thread_gets_the_lowest_real_time_priority(asked: list[tuple[int, int, int]]) -> None:
    assert ask_for_realtime([11, 12]) is None
    policy = os.SCHED_RR | os.SCHED_RESET_ON_FORK
    assert asked == [(11, policy, 1), (12, policy, 1)]


def test_a_refusal_says_why_and_who_may(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    refused = ask_for_realtime([1])
    assert refused is not None
    assert "Operation not permitted" in refused
    assert "rtprio" in refused


def test_another_system_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert ask_for_realtime([1]) == "there is none on darwin"
