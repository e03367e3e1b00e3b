"""What each compiled loop of the default pipeline takes: to compile, and in a frame with contact.

python benchmarks/kernels.py [--scene press]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import Counter, defaultdict
from statistics import median
from typing import Any

os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()

import tactflow
from tactflow.vision import compiled


def main() -> None:
    """Print a line for each loop."""
    parser = argparse.ArgumentParser(description="What each compiled loop takes.")
    parser.add_argument("--scene", default="press", help="a simulated scene (default: press)")
    scene = parser.parse_args().scene
    pipeline = tactflow.load(source=f"sim:{scene}?frames=240", settings={"sinks": {}})
    compiling: dict[str, float] = {}
    for kernel in compiled._kernels:
        began = time.process_time()
        _ = kernel.compiled
        compiling[kernel.__name__] = time.process_time() - began
    calls: Counter[str] = Counter()
    times: dict[str, list[float]] = defaultdict(list)
    call = compiled.Kernel.__call__

    def timed(kernel: compiled.Kernel[..., Any], *args: Any) -> Any:
        began = time.perf_counter()
        result = call(kernel, *args)
        times[kernel.__name__].append(1e6 * (time.perf_counter() - began))
        calls[kernel.__name__] += 1
        return result

    compiled.Kernel.__call__ = timed  # type: ignore[method-assign, assignment]
    contacts = sum(result.contact is not None for result in tactflow.stream(pipeline))
    print(f"{'loop':<24}{'calls per contact':>20}{'us per call':>14}{'s to compile':>14}")
    for name, seconds in compiling.items():
        per_call = f"{median(times[name]):.1f}" if times[name] else "-"
        print(f"{name:<24}{calls[name] / contacts:>20.2f}{per_call:>14}{seconds:>14.2f}")
    print(f"{'all ' + str(len(compiling)):<24}{'':>34}{sum(compiling.values()):>14.1f}")


if __name__ == "__main__":
    main()
