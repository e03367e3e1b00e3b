"""Feeds damaged input to every parser: `make fuzz`, or `python -m tests.fuzz --help`.

A parser may refuse its input, but neither fail, hang nor take memory beyond measure.
"""

from __future__ import annotations

import argparse
import faulthandler
import itertools
import os
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Before tactflow is imported: what a picture may claim, it may also take.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(1 << 20)

if TYPE_CHECKING:
    from tests.fuzz.targets import Parser

HANGS_AFTER = 60.0
"""Time after which one input counts as one that hangs, s: a thousand times what they take. Chosen by hand."""
ALLOWANCE = 48 << 20
"""Memory that an input may take whatever its size, bytes: what is imported and cached on the way, and the
largest picture a few times. Chosen by hand."""
FACTOR = 64
"""And so many times its size: a value of a YAML list is an object with its place, of a byte or two."""


def try_input(parser: Parser, data: bytes, kept: Path) -> bool:
    """Feed one input, which is in the file `kept` while it is tried; whether the parser refused it.

    Raises what the parser should not have raised. A crash or a hang ends the process.
    """
    kept.write_bytes(data)
    failed: list[BaseException] = []
    before, threading.excepthook = threading.excepthook, lambda of: failed.append(of.exc_value)
    faulthandler.dump_traceback_later(HANGS_AFTER, exit=True)
    if sys.platform == "linux":
        # Measure the peak anew.
        Path("/proc/self/clear_refs").write_text("5")
    memory = _memory("VmRSS")
    refused = False
    try:
        parser.feed(data)
    except parser.refusals:
        refused = True
    finally:
        faulthandler.cancel_dump_traceback_later()
        threading.excepthook = before
    if failed:
        raise failed[0]
    taken = _memory("VmHWM") - memory
    if taken > ALLOWANCE + FACTOR * len(data):
        raise MemoryError(f"{taken >> 20} MB for {len(data)} bytes")
    kept.unlink()
    return refused


def _memory(key: str) -> int:
    """What Linux says of this process' memory, bytes; 0 elsewhere."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else [f"{key} 0"]
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith(key))


def main() -> int:
    """Run; 1 if something was found."""
    from tests.fuzz.mutation import Mutator
    from tests.fuzz.targets import TARGETS

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[[], *TARGETS], help="default: all")
    parser.add_argument("--inputs", type=int, default=sys.maxsize, help="of each parser")
    parser.add_argument("--seconds", type=float, default=1e9, help="for each parser")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where inputs that show something are kept")
    args: Any = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp(prefix="tactflow-fuzz-"))
    folder.mkdir(parents=True, exist_ok=True)
    faulthandler.enable()
    inputs = refused = findings = 0
    for name in args.targets or TARGETS:
        began, kept = time.monotonic(), folder / name
        with tempfile.TemporaryDirectory() as scratch, TARGETS[name](Path(scratch)) as target:
            mutator = Mutator(target.samples, args.seed)
            damaged = (mutator.next() for _ in range(args.inputs))
            for data in itertools.chain(target.samples, damaged):
                inputs += 1
                try:
                    refused += try_input(target, data, kept)
                except Exception:
                    # The next parser: this one would show the same again and again.
                    findings += 1
                    print(f"FOUND {kept}\n{traceback.format_exc()}", file=sys.stderr, flush=True)
                    break
                if time.monotonic() - began > args.seconds:
                    break
    print(f"{inputs} inputs, {refused} refused, {findings} findings ({folder})")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
