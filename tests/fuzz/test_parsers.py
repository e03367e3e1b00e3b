"""Damaged input to every parser, a little of it; `make fuzz` tries more."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

INPUTS = 40
"""Of each parser. Enough to run through each; finding something new takes `make fuzz`. Chosen by hand."""


def fuzz(folder: Path, *options: str) -> str:
    """In a process of its own, as what is wrong may end it; what it says at the end."""
    command = [sys.executable, "-m", "tests.fuzz", "--folder", str(folder), *options]
    result = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr[-4000:]
    return result.stdout


def test_damaged_input_is_refused_and_never_crashes_hangs_or_fills_the_memory(tmp_path: Path) -> None:
    said = fuzz(tmp_path, "--inputs", str(INPUTS))
    assert re.fullmatch(r"\d{3,} inputs, \d{3,} refused, 0 findings .*\n", said)


@pytest.mark.slow
def test_much_damaged_input_is_refused_too(tmp_path: Path) -> None:
    assert ", 0 findings " in fuzz(tmp_path, "--seconds", "15", "--seed", "7")
