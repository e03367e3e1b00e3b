"""What each compiled loop gains a frame: `python -m lab.kernels [--scene press] [--frames 90]`.

Every call of a loop is timed; every `PLAIN_CALL_STEP`-th one is repeated in NumPy on copies of its
arguments. A loop earns its place with 0.03 ms a frame (`tactflow.vision.compiled`); one that NumPy is this
near to should be NumPy alone. Loops that the pipeline does not call are listed with no time."""

from __future__ import annotations

import argparse
import inspect
import time
from collections import defaultdict
from typing import Any

import numpy as np

import tactflow
from tactflow.vision import compiled

PLAIN_CALL_STEP = 5
"""Calls of a loop for each one that is repeated in NumPy."""


class Times:
    """CPU seconds and number of the calls of one loop, in C and in NumPy."""

    def __init__(self) -> None:
        self.compiled: list[float] = []
        self.plain: list[float] = []


def timed(times: dict[str, Times]) -> Any:
    """A replacement of `Kernel.__call__` that measures."""
    original = compiled.Kernel.__call__

    def call(self: Any, *args: Any, **kwargs: Any) -> Any:
        own = times[self.__name__]
        if len(own.compiled) % PLAIN_CALL_STEP == 0:
            copies = [value.copy() if isinstance(value, np.ndarray) else value for value in args]
            with np.errstate(all="ignore"):
                began = time.thread_time()
                self.plain(*copies)
                own.plain.append(time.thread_time() - began)
        began = time.thread_time()
        result = original(self, *args, **kwargs)
        own.compiled.append(time.thread_time() - began)
        return result

    return call


def measure(pipeline: str, scene: str, frames: int) -> tuple[dict[str, Times], int]:
    """Times of each loop in a run, and the number of frames with a contact."""
    times: dict[str, Times] = defaultdict(Times)
    original = compiled.Kernel.__call__
    compiled.Kernel.__call__ = timed(times)  # type: ignore[method-assign]
    try:
        source = f"sim:{scene}?frames={frames}"
        results = tactflow.stream(pipeline, source=source, settings={"sinks": {}})
        touched = sum(result.contact is not None for result in results)
    finally:
        compiled.Kernel.__call__ = original  # type: ignore[method-assign]
    return times, touched


def main() -> None:
    """Measure and print a Markdown table."""
    parser = argparse.ArgumentParser(description="What each compiled loop gains a frame.")
    parser.add_argument("--pipeline", default="default")
    parser.add_argument("--scene", default="press")
    parser.add_argument("--frames", type=int, default=90)
    args = parser.parse_args()
    times, touched = measure(args.pipeline, args.scene, args.frames)
    print(f"{args.pipeline} on {args.scene}, {args.frames} frames, {touched} with contact\n")
    print("| loop | file | lines | calls a frame | in C, ms a frame | NumPy | gain |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: |")
    for kernel in compiled.kernels():
        own, plain = times[kernel.__name__], kernel.plain
        file = inspect.getsourcefile(plain) or ""
        lines = len(inspect.getsourcelines(plain)[0])
        head = f"| `{kernel.__name__}` | {file.partition('tactflow/vision/')[2]} | {lines} |"
        if not own.compiled:
            print(f"{head} 0 | | | |")
            continue
        calls = len(own.compiled) / args.frames
        fast, slow = calls * 1e3 * np.median(own.compiled), calls * 1e3 * np.median(own.plain)
        print(f"{head} {calls:.2f} | {fast:.3f} | {slow:.2f} | {slow - fast:.2f} |")


if __name__ == "__main__":
    main()
