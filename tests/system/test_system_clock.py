"""Steps of the system clock, by hand, by NTP, by daylight: they change neither order nor durations."""

from __future__ import annotations

import re
import time
from itertools import pairwise

import pytest

from tactflow.sources import open_source
from tactflow.sources.watch import Watch, Watched
from tests.conftest import REPOSITORY


def test_a_watched_source_takes_no_step_for_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = iter([1e9 + (-1) ** look * 3.2e7 for look in range(1000)])
    monkeypatch.setattr(time, "time", lambda: next(steps))
    source = Watched(lambda: open_source("sim:idle?frames=1000"), Watch(), "example")
    times = []
    for _ in range(10):
        item = source.read()
        assert item is not None
        times.append(item[1])
        assert source.state == "running"
    source.close()
    assert all(later > earlier for earlier, later in pairwise(times))


def test_only_one_file_asks_the_system_what_time_it_is() -> None:
    # A date for people, as in a calibration, is no time that anything is compared with.
    asks = re.compile(r"\btime\.time(_ns)?\(|\btime\.clock_gettime")
    files = [file for folder in ("src", "stages", "sinks") for file in (REPOSITORY / folder).rglob("*.py")]
    assert len(files) > 100
    asking = [file.name for file in files if asks.search(file.read_text(encoding="utf-8"))]
    assert asking == ["clock.py"]
