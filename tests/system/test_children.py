"""Python processes that tactflow starts: what they import, and which signals reach them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.clock import PATIENCE

STARTS_A_CHILD = """
import multiprocessing
import re
import signal
from multiprocessing import resource_tracker
from pathlib import Path
from tactflow.system.children import starting_children
from tactflow.system.signals import ENDING_SIGNALS

def blocked(process):
    status = Path(f"/proc/{process}/status").read_text()
    mask = int(re.search("SigBlk:\\t(.*)", status)[1], 16)
    return all(mask >> (number - 1) & 1 for number in ENDING_SIGNALS)

if __name__ == "__main__":
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    with starting_children(ENDING_SIGNALS):
        child = multiprocessing.get_context("spawn").Process(target=print, args=("child",))
        child.start()
    assert blocked(child.pid)
    assert blocked(resource_tracker._resource_tracker._pid)
    child.join()
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before
"""
SHADOW = "print('imported from the current folder')"


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
def test_a_process_of_multiprocessing_imports_nothing_from_there_and_no_signal_reaches_it(
    tmp_path: Path,
) -> None:
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.mkdir()
    elsewhere.mkdir()
    (here / "pickle.py").write_text(SHADOW)
    (elsewhere / "program.py").write_text(STARTS_A_CHILD)
    command = [sys.executable, str(elsewhere / "program.py")]
    done = subprocess.run(command, cwd=here, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (0, "child\n"), done.stderr
