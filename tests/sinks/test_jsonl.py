"""The JSON Lines sink: complete lines, no lost data, clear errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.sinks.jsonl import Jsonl
from tests.clock import until

IMAGE = np.zeros((3, 4, 3), np.uint8)


def opened(path: Path | str, **params: Any) -> Jsonl:
    sink = Jsonl(Jsonl.Params(path=str(path), **params))
    sink.open()
    return sink


def write(sink: Jsonl, seqs: range) -> None:
    for seq in seqs:
        sink.write(Result(Frame("main", seq, seq / 10.0, IMAGE)))


def seqs_in(path: Path) -> list[int]:
    text = path.read_text()
    assert text == "" or text.endswith("\n")
    return [json.loads(line)["seq"] for line in text.splitlines()]


def test_every_frame_is_one_line_and_folders_are_created(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "results.jsonl"
    sink = opened(path)
    write(sink, range(20))
    sink.close()
    assert seqs_in(path) == list(range(20))
    assert sink.counters() == {"lines": 20}


def test_lines_wait_for_the_interval_or_the_end(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    sink = opened(path, flush=3600.0)
    write(sink, range(3))
    assert seqs_in(path) == []
    sink.close()
    assert seqs_in(path) == [0, 1, 2]
    at_once = opened(path, append=True, flush=0.0)
    write(at_once, range(3, 4))
    assert seqs_in(path) == [0, 1, 2, 3]
    at_once.close()


def test_standard_output_gets_every_line_at_once(capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    sink = opened("-", flush=60.0)
    assert sink.wants()
    write(sink, range(2))
    out = b""

    def all_are_there() -> bool:
        nonlocal out
        out += capfdbinary.readouterr().out
        return out.count(b"\n") == 2

    until(all_are_there)
    assert [json.loads(line)["seq"] for line in out.splitlines()] == [0, 1]
    sink.close()
    print("still open", flush=True)
    assert capfdbinary.readouterr().out == b"still open\n"
