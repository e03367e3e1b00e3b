"""Runs tests in a process that is stopped at random moments: what depends on how long something takes, fails.

    python -m tests.stalls --runs 20 tests/sources tests/engine tests/fleet tests/sinks/test_view.py

Load on the machine does not do this: it makes everything slower alike.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import time

SHORTEST_RUN = 0.02
"""Time between two stops at least, s: to start takes a moment. Chosen by hand."""


def main() -> int:
    """Run the tests so often; the number of runs that failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--longest", type=float, default=0.5, metavar="S", help="longest stop, s")
    parser.add_argument("--between", type=float, default=1.0, metavar="S", help="longest time between two, s")
    parser.add_argument("--seed", type=int, default=0)
    args, words = parser.parse_known_args()
    # A shell has what runs in the background ignore it, and programs that tests interrupt would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    failed = 0
    for number in range(args.runs):
        rng = random.Random(args.seed + number)
        code, stops, seconds = run_stalled(words, rng, args.longest, args.between)
        failed += code != 0
        print(
            f"run {number + 1} of {args.runs}: exit code {code}, stopped {stops} times for {seconds:.1f} s",
            flush=True,
        )
    print(f"{failed} of {args.runs} runs failed")
    return failed


def run_stalled(
    words: list[str], rng: random.Random, longest: float, between: float
) -> tuple[int, int, float]:
    """One run of pytest; its exit code, how often it was stopped, and for how many seconds in all."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "--tb=short", *words]
    process = subprocess.Popen(command)
    stops, seconds = 0, 0.0
    while process.poll() is None:
        time.sleep(rng.uniform(SHORTEST_RUN, between))
        stop = rng.uniform(0.0, longest)
        process.send_signal(signal.SIGSTOP)
        time.sleep(stop)
        process.send_signal(signal.SIGCONT)
        stops, seconds = stops + 1, seconds + stop
    return process.returncode, stops, seconds


if __name__ == "__main__":
    sys.exit(main())
