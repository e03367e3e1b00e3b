"""Records frames until it is killed: one process of its own per line of standard input.

A line is `FILE COUNTER`. The counter holds the number of frames whose `write` has returned.
"""

from __future__ import annotations

import os
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np

from tactflow.engine.frame import Frame, Tick
from tactflow.sinks.record import Record
from tests.messages import Results, result_of


@lru_cache(maxsize=10_000)
def image(seq: int) -> np.ndarray:
    return np.random.default_rng(seq).integers(0, 256, (24, 32, 3), np.uint8)


def record(path: str, counter: str) -> None:
    sink = Record(Record.Params(path=path))
    sink.open()
    count = os.open(counter, os.O_CREAT | os.O_WRONLY)
    for seq in range(1_000_000):
        sink.write(result_of(Tick(Frame("main", seq, seq / 60, image(seq), reference=seq == 0)), Results()))
        os.pwrite(count, (seq + 1).to_bytes(8, "little"), 0)


if __name__ == "__main__":
    for line in sys.stdin:
        path, counter = line.split()
        child = os.fork()
        if child == 0:
            record(path, counter)
        print(child, flush=True)
        # Wait for it to be killed.
        os.waitpid(child, 0)
        print(Path(path).stat().st_size, flush=True)
