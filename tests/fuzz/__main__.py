"""Feeds damaged input to every parser: `make fuzz`, or `python -m tests.fuzz --help`."""

from __future__ import annotations

import argparse
import faulthandler
import itertools
import os
import sys
import tempfile
import time
from pathlib import Path

# Before tactflow is imported: what a picture may claim, it may also take.
os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"] = str(1 << 20)

TURN = 50
"""Inputs of one parser until it is the next one's turn."""


def main() -> int:
    """Run; 1 if something was found."""
    from tests.fuzz.guard import Findings
    from tests.fuzz.targets import TARGETS

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[[], *TARGETS], help="default: all")
    parser.add_argument("--inputs", type=int, default=None, help="of each parser")
    parser.add_argument("--seconds", type=float, default=None, help="for each parser")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where inputs that show something are kept")
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp(prefix="tactflow-fuzz-"))
    folder.mkdir(parents=True, exist_ok=True)
    faulthandler.enable()
    findings = Findings(folder)
    for name in args.targets or TARGETS:
        _fuzz(findings, name, args.inputs, args.seconds, args.seed)
    print(f"{findings.inputs} inputs, {findings.refused} refused, {len(findings.found)} findings ({folder})")
    return 1 if findings.found else 0


def _fuzz(findings: object, name: str, inputs: int | None, seconds: float | None, seed: int) -> None:
    from tests.fuzz.guard import Findings, try_input
    from tests.fuzz.mutation import Mutator
    from tests.fuzz.targets import TARGETS

    assert isinstance(findings, Findings)
    began, count, refused = time.monotonic(), 0, findings.refused
    with tempfile.TemporaryDirectory() as scratch, TARGETS[name](Path(scratch)) as parser:
        for sample in parser.samples:
            try_input(findings, name, parser.feed, sample, parser.refusals)
        mutator = Mutator(parser.samples, seed)
        for count in itertools.count(1):
            if (inputs is not None and count > inputs) or (
                seconds is not None and time.monotonic() - began > seconds
            ):
                break
            try_input(findings, name, parser.feed, mutator.next(), parser.refusals)
    print(
        f"{name:14} {count - 1} inputs, {findings.refused - refused} refused, "
        f"{time.monotonic() - began:.1f} s",
        file=sys.stderr,
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
