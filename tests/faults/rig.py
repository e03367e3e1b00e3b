"""One run in this process, with something going wrong at one of its frames."""

from __future__ import annotations

import logging
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tactflow.config.load import load_pipeline
from tactflow.engine.contract import Sink
from tactflow.engine.frame import Tick
from tactflow.engine.run import Runner

FRAMES = 120
FAULT_AT = 60
"""Frames of a run, and the one at which the fault comes: the queues in front of sinks hold 32 at most."""
DISK = "24m"
"""Size of a small disk: more than the 16 MB that a film wants to be free."""


@dataclass(frozen=True)
class Seen:
    """What a user sees of a run. exit : code. said : warnings and the error. kept : what is left behind."""

    exit: int
    said: str
    kept: str = ""

    def must_be(self, exit_: int, said: str = "^$", kept: str = "") -> None:
        """said, kept : regular expressions."""
        assert self.exit == exit_, self
        assert re.search(said, self.said, re.DOTALL), self
        assert re.search(kept, self.kept, re.DOTALL), self


class At(Sink):
    """Lets the fault come, once."""

    fault: Callable[[], object] | None = None

    def write(self, tick: Tick) -> None:
        fault = type(self).fault
        if fault is not None and tick.frame.seq >= FAULT_AT:
            type(self).fault = None
            fault()


def array(folder: Path, frames: int = FRAMES) -> Path:
    """A recording of noise on a gradient, 160 x 120, as an array: so large that encoders do not keep all of
    it."""
    path = folder / "noise.npy"
    noise = np.random.default_rng(1).integers(0, 128, (frames, 120, 160, 3), np.uint8)
    np.save(path, noise + np.linspace(0, 127, 160).astype(np.uint8)[:, None])
    return path


@contextmanager
def heard() -> Iterator[list[str]]:
    """The warnings of a block."""
    said: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
    logger = logging.getLogger("tactflow")
    logger.addHandler(handler)
    try:
        yield said
    finally:
        logger.removeHandler(handler)


def write_pipeline(folder: Path, sinks: Mapping[str, Any], **capture: Any) -> Path:
    """A pipeline file of a source, a copy of its picture and some sinks."""
    file = folder / "pipeline.yaml"
    stages = {"capture": {"settle": 0, **capture}, "preprocess": {}}
    file.write_text(yaml.safe_dump({"opencv_threads": 1, "stages": stages, "sinks": dict(sinks)}))
    return file


def run(
    folder: Path,
    sinks: Mapping[str, Any],
    fault: Callable[[Runner], object] = lambda _: None,
    beside: Callable[[Runner], object] = lambda _: None,
    max_frames: int | None = None,
    **capture: Any,
) -> tuple[Runner, Seen]:
    """Run with a fault at one frame; what was seen. beside : goes on in another thread meanwhile."""
    file = write_pipeline(folder, {"at": {"use": "tests.faults.rig:At"}, **sinks}, **capture)
    with heard() as said:
        runner = Runner(load_pipeline(file), max_frames=max_frames)
        At.fault = lambda: fault(runner)
        thread = threading.Thread(target=beside, args=(runner,))
        thread.start()
        result = runner.run()
        thread.join()
    return runner, Seen(result.exit_code, "\n".join([*said, result.error or ""]).strip())


@contextmanager
def small_disk(*options: str) -> Iterator[Path]:
    """A folder on a disk of its own; skips where that cannot be had."""
    if shutil.which("mount") is None:
        pytest.skip("there is no mount")
    folder = Path(tempfile.mkdtemp(prefix="tactflow-disk-"))
    mount = ["mount", "-t", "tmpfs", "-o", ",".join([f"size={DISK}", *options]), "tmpfs", str(folder)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        folder.rmdir()
        pytest.skip("to mount a small disk takes an administrator")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
        folder.rmdir()


def fill(folder: Path) -> None:
    """Leave not a byte free on the disk of a folder."""
    with (folder / "filler").open("wb", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            try:
                while file.write(bytes(size)):
                    pass
            except OSError:
                continue
