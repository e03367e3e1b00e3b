"""What a Ctrl-C ends, and with which exit code."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tactflow.system.signals import ENDING_SIGNALS, ending_handled, interrupt
from tests.clock import PATIENCE, until

ENDS = [number for number in ENDING_SIGNALS if sys.platform != "win32"]
"""Windows ends another process at once instead of sending it one of them."""


def interrupted(folder: Path, words: list[str], *numbers: int) -> tuple[int, str]:
    """Exit code and standard error of a program that gets signals.

    Each waits for a file of the program's, `ready-1`, `ready-2`, ..., and there is `sent-1`, ... after it.
    """
    command = [sys.executable, "-m", "tactflow", *words]
    with subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True) as process:
        for count, number in enumerate(numbers, start=1):
            ready = folder / f"ready-{count}"
            until(lambda ready=ready: process.poll() is not None or ready.exists())
            process.send_signal(number)
            (folder / f"sent-{count}").touch()
        _, errors = process.communicate(timeout=PATIENCE)
    return process.returncode, errors


# No file object: what a signal raises while Python frees one is dropped.
BLOCKS = f"import os, time; os.close(os.open('ready-1', os.O_CREAT)); time.sleep({PATIENCE})"


@pytest.mark.parametrize("number", ENDS)
@pytest.mark.parametrize(("command", "code"), [("check", 130), ("listen", 0), ("run", 0)])
def test_a_signal_while_the_program_is_imported(command: str, code: int, number: int, tmp_path: Path) -> None:
    # Stands in for the module of that name, which the program imports first.
    (tmp_path / "difflib.py").write_text(BLOCKS)
    assert interrupted(tmp_path, [command], number) == (code, "")


TIDIES = f"""
import time
from pathlib import Path

try:
    # Within `exec` of a text, a KeyboardInterrupt itself ends Python by SIGINT.
    exec({BLOCKS!r})
finally:
    Path("ready-2").touch()
    while not Path("sent-2").exists():
        time.sleep(0.001)
    Path("tidied").touch()
"""


@pytest.mark.parametrize("number", ENDS)
def test_a_second_signal_does_not_keep_a_command_from_tidying_up(number: int, tmp_path: Path) -> None:
    (tmp_path / "late.py").write_text(TIDIES)
    assert interrupted(tmp_path, ["stages", "./late.py:Late"], number, number) == (130, "")
    assert (tmp_path / "tidied").exists()


def test_a_third_signal_is_not_caught() -> None:
    with ending_handled(interrupt):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
