"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests import chromium
from tests.terminal import Terminal

REPOSITORY = Path(__file__).resolve().parent

# Matrices here are small: threads of the linear algebra would wait in a loop and take half of the processors.
for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")

# Tests start hundreds of processes; without files of byte code each would compile every module anew (0.3 s).
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Who runs the tests in the background of a script ignores Ctrl-C, and programs inherit what is ignored; those
# that tests start shall not.
for number in (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if sys.platform != "win32" else [])):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

MOST_WORKERS = 4
"""Processes that run tests at most: many tests watch a run in real time and need a processor then."""

LONG_FILES = (
    "test_install.py",
    "tools/bench/test_run.py",
    "browser/test_view_page.py",
    "test_main_job.py",
    "browser/test_start.py",
    "tools/start/test_start.py",
    "tools/fleet/test_fleet.py",
    "tools/batch/test_workers.py",
    "cli/test_calibrate.py",
    "cli/test_record.py",
)
"""The files of tests that take longest, from a minute down to ten seconds. They begin first, so that no
process is left alone with one at the end."""

# How fast examples are made, and run, is the machine's business.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")


def pytest_xdist_auto_num_workers() -> int:
    """One process more than there are processors: tests that start programs mostly wait."""
    return min((os.cpu_count() or 1) + 1, MOST_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first, the others in the order in which they were found."""
    places = {REPOSITORY / "tests" / name: place for place, name in enumerate(LONG_FILES)}
    assert all(path.is_file() for path in places), "a file of LONG_FILES is not there any more"
    items.sort(key=lambda item: places.get(item.path, len(places)))


def pytest_collection_finish() -> None:
    """What was collected stays to the end: 380,000 objects, at which each full collection of garbage would
    look, 0.2 s each time (measured). The quick bench alone makes some thirty of them."""
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; skips where it is missing."""
    folder = REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here: {folder}")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One headless Chromium for all tests of a file."""
    with chromium.launched() as started:
        yield started


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens pages. A complaint in the console, a script error or a request to elsewhere fails the test.

    everywhere : they may ask other ports of this machine. lost : they may lose the server. browser : another
    one. options : of the browser's context.
    """
    complaints: list[str] = []
    with ExitStack() as stack:

        def open_(
            url: str, *, everywhere: bool = False, lost: bool = False, browser: Any = browser, **options: Any
        ) -> Any:
            options = {"viewport": {"width": 1400, "height": 900}, "color_scheme": "dark"} | options
            page = stack.enter_context(closing(browser.new_context(**options))).new_page()
            page.set_default_timeout(chromium.PATIENCE)

            def complain(message: Any) -> None:
                # Chromium reports each attempt to reach a server that is gone.
                expected = lost and "ERR_CONNECTION_REFUSED" in message.text
                if message.type in ("error", "warning") and not expected:
                    complaints.append(message.text)

            def check_target(request: Any) -> None:
                origin = "http://127.0.0.1:" if everywhere else url
                if not request.url.startswith(origin):
                    complaints.append(f"asked for {request.url}")

            page.on("console", complain)
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on("request", check_target)
            page.goto(url)
            return page

        yield open_
    assert complaints == []


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Closes what a test opened, last first."""
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Terminal:
    """The command line in an empty folder, `tmp_path`."""
    monkeypatch.chdir(tmp_path)
    return Terminal(capsys)
