"""No frame waits for a kernel to be compiled."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

RUN = """
import sys

from tactflow.config.shipped import find_pipeline
from tactflow.config.load import load_pipeline
from tactflow.engine.run import Runner
from tactflow.vision import compiled, geometry

begun, late, early = [], [], []
load_kernel, convert = compiled.Kernel._load, geometry.Preprocessor.__call__


def watched(kernel, wait):
    (late if begun else early).append(kernel.__name__)
    return load_kernel(kernel, wait)


def first(self, *args, **kwargs):
    begun.append(True)
    return convert(self, *args, **kwargs)


compiled.Kernel._load, geometry.Preprocessor.__call__ = watched, first
overrides = ["stages.capture.source=sim:%s?frames=60", "sinks={jsonl: {path: results.jsonl}}"]
result = Runner(load_pipeline(find_pipeline("%s"), overrides)).run()
print(result.error, len(begun) > 10, len(early) > 5, late)
"""


@pytest.mark.parametrize(("pipeline", "scene"), [("default", "jumps"), ("markerless", "unmarked")])
def test_every_kernel_is_compiled_before_the_first_frame(pipeline: str, scene: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", RUN % (scene, pipeline)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "None True True []", done.stderr
