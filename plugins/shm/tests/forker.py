"""Starts writers and readers at once, by forking: `writer SENSOR` or `reader SENSOR` on a line of standard
input prints the process id, `reap ID` waits for its end and prints the id again."""

from __future__ import annotations

import os
import sys
from itertools import count

import numpy as np

import tactflow
from tactflow import Frame, Result
from tactflow.plugins.shm.reader import SharedReader
from tactflow.plugins.shm.sink import Shm


def write(sensor: str) -> None:
    """Uniform pictures without a pause; the level is seq modulo 251."""
    sink = Shm(Shm.Params(ports=["raw"]), sensor)
    sink.open()
    for seq in count():
        image = np.full((600, 800, 3), seq % 251, np.uint8)
        sink.write(Result(Frame(sensor, seq, seq / 60, image)))


def read(sensor: str) -> None:
    """Use every picture."""
    with SharedReader(sensor, "raw") as pictures:
        for picture in pictures:
            assert picture.array is not None
            picture.array.sum()


def main() -> None:
    """Obey until the end of standard input."""
    assert tactflow.SharedReader is SharedReader
    for line in sys.stdin:
        command, word = line.split()
        if command == "reap":
            os.waitpid(int(word), 0)
            print(word, flush=True)
            continue
        child = os.fork()
        if child == 0:
            try:
                {"writer": write, "reader": read}[command](word)
            finally:
                os._exit(1)
        print(child, flush=True)


if __name__ == "__main__":
    main()
