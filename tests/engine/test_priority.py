"""Short slices of the processor: asked for where Linux knows them, and nothing else changed."""

from __future__ import annotations

import os
import platform
import threading
from collections.abc import Callable

import pytest

from tactflow.engine import priority
from tactflow.engine.priority import serve_soon


def in_a_thread(work: Callable[[], object]) -> object:
    """Run in a thread of its own, so that the test's own keeps its slices."""
    found: list[object] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


def knows_slices() -> bool:
    """Whether this kernel is Linux 6.12 or newer."""
    if platform.system() != "Linux" or platform.machine() not in priority._CALLS:
        return False
    major, minor = (int(part) for part in platform.release().split(".")[:2])
    return (major, minor) >= (6, 12)


def test_slices_are_granted_by_kernels_that_know_them() -> None:
    if not knows_slices():
        pytest.skip("slices can be asked for from Linux 6.12 on")
    assert in_a_thread(serve_soon) is True


def test_policy_and_nice_value_stay() -> None:
    def ask() -> tuple[object, object]:
        def kept() -> tuple[int, int]:
            return os.getpriority(os.PRIO_PROCESS, threading.get_native_id()), os.sched_getscheduler(0)

        before = kept()
        serve_soon()
        return before, kept()

    before, after = in_a_thread(ask)  # type: ignore[misc]
    assert before == after


@pytest.mark.parametrize(
    ("system", "machine"), [("Darwin", "arm64"), ("Windows", "AMD64"), ("Linux", "riscv64")]
)
def test_other_systems_are_left_alone(system: str, machine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(priority.ctypes, "CDLL", lambda _: pytest.fail("the system was called"))
    assert serve_soon() is False


def test_a_slice_that_no_kernel_grants_is_refused_and_nothing_raised() -> None:
    # Longer than Linux allows (100 ms): it grants less, or nothing.
    assert in_a_thread(lambda: serve_soon(10**12)) is False
