"""What the shipped pipelines give to each kernel: the data on which kernels are compared and measured."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.run import Runner
from tactflow.vision.compiled import Kernel

Arguments = tuple[Any, ...]

RUNS = (
    # The last of these frames is in the deepest part of the first press: 300 x 400 px, 80 dots.
    ("default", "press?frames=300", 60),
    # Marks that are lost are searched for.
    ("default", "jumps?frames=300", 300),
)
"""Pipeline, scene, and number of frames, in the order in which they are asked."""


def typical_arguments(kernel: str) -> Arguments:
    """Arguments of the last call of a kernel in the first of `RUNS` that calls it; they may be written to.

    Raises
    ------
    LookupError : none of them calls it: its `Gain` must bring its own arguments.
    """
    for run in RUNS:
        recorded = _recorded(*run)
        if kernel in recorded:
            return duplicate(recorded[kernel])
    raise LookupError(f"no shipped pipeline calls {kernel}: its Gain needs `arguments`")


def duplicate(arguments: Arguments) -> Arguments:
    """Arguments with copies of the arrays."""
    return tuple(_copy(value) for value in arguments)


def _copy(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        return value
    copy = value.copy()
    copy.setflags(write=value.flags.writeable)
    return copy


@cache
def _recorded(pipeline: str, scene: str, frames: int) -> dict[str, Arguments]:
    """Kernel -> arguments of its last call in this run, before the call."""
    found: dict[str, Arguments] = {}
    call = Kernel.__call__

    def recorded(self: Kernel[..., Any], *args: Any) -> Any:
        found[self.name] = duplicate(args)
        return call(self, *args)

    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setattr(Kernel, "__call__", recorded)
        overrides = [
            f"stages.capture.source=sim:{scene}",
            f"sinks={{jsonl: {{path: '{Path(folder) / 'results.jsonl'}'}}}}",
        ]
        outcome = Runner(load_pipeline(find_pipeline(pipeline), overrides), max_frames=frames).run()
        if outcome.error is not None:
            raise outcome.error
    return found
