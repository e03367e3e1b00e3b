"""Feeds damaged input to every parser: `make fuzz`, or `python -m tests.fuzz --help`.

A parser may refuse its input, but neither fail, hang nor take memory beyond measure.
"""

from __future__ import annotations

import argparse
import faulthandler
import hashlib
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


class Findings:
    """What went wrong, once for each place in the code; the first input that shows it is kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.inputs = self.refused = 0
        self.found: set[tuple[str, ...]] = set()

    def add(self, target: str, kind: str, place: str, data: bytes) -> None:
        """Keep a finding, unless its like is known."""
        if (target, kind, place) not in self.found:
            self.found.add((target, kind, place))
            path = self.folder / f"{target}-{hashlib.sha256(data).hexdigest()[:12]}"
            path.write_bytes(data)
            print(f"FOUND {target}: {kind}\n      {place}\n      {path}", file=sys.stderr, flush=True)

    def try_input(self, target: str, parser: Parser, data: bytes) -> None:
        """Feed one input. A crash or a hang ends the process; the input is then in `current-TARGET`."""
        current = self.folder / f"current-{target}"
        current.write_bytes(data)
        self.inputs += 1
        failed: list[BaseException] = []
        before, threading.excepthook = threading.excepthook, lambda of: failed.append(of.exc_value)
        faulthandler.dump_traceback_later(HANGS_AFTER, exit=True)
        if sys.platform == "linux":
            # Measure the peak anew.
            Path("/proc/self/clear_refs").write_text("5")
        memory = _memory("VmRSS")
        try:
            parser.feed(data)
        except parser.refusals:
            self.refused += 1
        except Exception as error:
            failed.append(error)
        finally:
            faulthandler.cancel_dump_traceback_later()
            threading.excepthook = before
        for error in failed:
            last = traceback.extract_tb(error.__traceback__)[-3:]
            place = " > ".join(f"{Path(frame.filename).name}:{frame.lineno}" for frame in last)
            self.add(target, f"{type(error).__name__}: {str(error)[:200]}", place, data)
        taken = _memory("VmHWM") - memory
        if taken > ALLOWANCE + FACTOR * len(data):
            self.add(target, "memory", f"{taken >> 20} MB for {len(data)} bytes", data)
        current.unlink()


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
    findings = Findings(folder)
    for name in args.targets or TARGETS:
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as scratch, TARGETS[name](Path(scratch)) as target:
            mutator = Mutator(target.samples, args.seed)
            damaged = (mutator.next() for _ in range(args.inputs))
            for data in itertools.chain(target.samples, damaged):
                findings.try_input(name, target, data)
                if time.monotonic() - began > args.seconds:
                    break
    print(f"{findings.inputs} inputs, {findings.refused} refused, {len(findings.found)} findings ({folder})")
    return 1 if findings.found else 0


if __name__ == "__main__":
    sys.exit(main())
