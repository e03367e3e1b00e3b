"""The environment in which LeRobot is: it takes other versions of OpenCV than the tests, and torch."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from tests.clock import PATIENCE
from tests.paths import REPOSITORY

PYTHON = Path(os.environ.get("LEROBOT_PYTHON") or REPOSITORY / ".venv-lerobot" / "bin" / "python")
PACKAGES = PYTHON.parent.parent / "lib"

needs_lerobot = pytest.mark.skipif(not PYTHON.exists(), reason="LeRobot is not here: make lerobot-env")
needs_datasets = pytest.mark.skipif(
    not any(PACKAGES.glob("python*/site-packages/torch")),
    reason="LeRobot's datasets are not here: make lerobot-datasets",
)


def run_with_lerobot(program: str, *arguments: str) -> str:
    """What a program prints there; the test fails with its complaints if it fails."""
    done = subprocess.run(
        [str(PYTHON), "-W", "ignore", "-c", program, *arguments],
        capture_output=True,
        text=True,
        # Importing PyTorch alone takes a minute on a busy machine.
        timeout=3 * PATIENCE,
        env=os.environ | {"HF_HUB_OFFLINE": "1"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()
