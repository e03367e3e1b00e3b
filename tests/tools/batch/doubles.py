"""Recordings, a pipeline, and workers in this process for tests of a batch."""

from __future__ import annotations

from concurrent.futures import Future
from pathlib import Path
from textwrap import dedent, indent

import numpy as np

from tactflow.tools.batch.store import Outcome
from tactflow.tools.batch.work import Task, work

PIPELINE = """
stages:
  capture: {source: "sim:idle", settle: 0}
  preprocess: {rotate: 0, downsample: 1}
  difference: {in: {unmarked: preprocess.image}, use: classic_difference}
  hull: {when: touching}
sinks: {}
"""
"""A pipeline without kernels."""


STAGE = """
import errno, os, pathlib, signal, time
from tactflow import Stage
from tactflow.ports import Image

HERE = pathlib.Path(__file__).parent

class Extra(Stage):
    memory = "pure"

    def process(self, image: Image) -> Image:
"""


def add_stage(folder: Path, body: str) -> None:
    """Write the pipeline `p.yaml` with one more stage, in `extra.py`. body : of `process`."""
    (folder / "extra.py").write_text(STAGE + indent(dedent(body).strip() + "\nreturn image\n", " " * 8))
    text = PIPELINE.replace("preprocess.image", "extra.image")
    (folder / "p.yaml").write_text(text.replace("  difference", "  extra: {use: ./extra.py}\n  difference"))


class InThisProcess:
    """Workers that are this process: starting others takes seconds."""

    description = "this process"
    slots = 2

    def __init__(self, _count: int = 1) -> None:
        pass

    def submit(self, task: Task) -> Future[Outcome]:
        future: Future[Outcome] = Future()
        future.set_result(work(task))
        return future

    def close(self, *, kill: bool) -> None:
        assert not kill


def recording(path: Path, *, brightness: int = 200, frames: int = 6) -> Path:
    """A .npy recording in which a bright square touches from the third frame on."""
    gel = np.linspace(50, 70, 64).astype(np.uint8)[:, None].repeat(3, axis=1)
    pictures = np.tile(gel, (frames, 48, 1, 1))
    pictures[2:, 16:32, 20:40] = brightness
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, pictures)
    return path
