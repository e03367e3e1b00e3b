"""What a Ctrl-C ends, and with which exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from threading import Thread

import pytest

from tactflow.signals import ending_held_back


def test_a_ctrl_c_waits_for_the_end_of_the_block() -> None:
    before = signal.getsignal(signal.SIGINT)
    done: list[bool] = []

    def work() -> None:
        with ending_held_back():
            signal.raise_signal(signal.SIGINT)
            done.append(True)

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == [True]
    assert signal.getsignal(signal.SIGINT) is before


def test_what_fails_in_the_block_is_told() -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(OSError, match="no process"), ending_held_back():
        raise OSError("no process")
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_need_not_wait() -> None:
    entered: list[bool] = []

    def enter() -> None:
        with ending_held_back():
            entered.append(True)

    thread = Thread(target=enter)
    thread.start()
    thread.join()
    assert entered == [True]


def test_the_exit_code_stands_wherever_the_signal_came(tmp_path: Path) -> None:
    # Seen to end by SIGINT in CPython 3.11 where a KeyboardInterrupt itself is raised.
    (tmp_path / "ending.py").write_text("""
import sys
from tactflow.signals import Interrupted
try:
    exec("raise Interrupted")
except KeyboardInterrupt:
    sys.exit(7)
""")
    assert subprocess.run([sys.executable, "-m", "ending"], cwd=tmp_path, check=False).returncode == 7
