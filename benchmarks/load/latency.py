"""Where the age of a live result comes from: writes the section "age" of docs/tuning.md.

    python -m benchmarks.load.latency

One sensor at 60 Hz and a subscriber in a process of its own, on a machine that is otherwise quiet.
"""

from __future__ import annotations

import argparse
import gc
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import zmq

from benchmarks.load.workload import write_pipeline, write_section
from tactflow.bench.lockstep import LockstepPipeline
from tactflow.bench.pipelines import on_recording
from tactflow.bench.timing import BLOCK
from tactflow.config.load import load_pipeline
from tactflow.engine.run import Runner
from tactflow.engine.trace import Trace
from tactflow.sim import open_scene
from tests.conftest import REPOSITORY

SIZE = (800, 600)
"""Of the pictures, px: the default pipeline halves them."""
RATE = 60.0
FRAMES = 1200
SETTLED = 300
"""Frames before the first one that counts: kernels, the reference, the subscription. Chosen by hand."""
PORT = 5790
PAUSES = (0, 3, 6, 15)
"""Between two frames, ms."""
PAUSED_FRAMES = 240
TOPIC = b"tactflow.main "
PAGE = REPOSITORY / "docs" / "tuning.md"
PARTS = (
    "the source's thread wakes",
    "to the thread of the stages",
    "stages",
    "between stages: gates, inputs, statistics",
    "to the thread of the publisher",
    "JSON and sending",
    "to the subscriber",
)

Slices = Mapping[str, tuple[float, float]]
"""What ran for a frame: name -> when it began and ended, s of the monotonic clock."""


def subscribe(endpoint: str, count: int) -> None:
    """Print [number of the frame, due, received] of each result, s, once `count` have come."""
    context = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.subscribe(TOPIC)
    socket.connect(endpoint)
    raw: list[tuple[bytes, float]] = []
    while len(raw) < count and socket.poll(5000 if raw else 60_000):
        raw.append((socket.recv(), time.perf_counter()))
    context.destroy(linger=0)
    bodies = [(json.loads(message.partition(b" ")[2]), when) for message, when in raw]
    print(json.dumps([(body["seq"], body["t"], when) for body, when in bodies]))


@contextmanager
def subscriber(endpoint: str) -> Iterator[subprocess.Popen[str]]:
    """A process that subscribes; what it prints can be read when it has ended."""
    command = [sys.executable, "-m", "benchmarks.load.latency", "--subscribe", endpoint]
    process = subprocess.Popen(command, cwd=REPOSITORY, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def run() -> tuple[dict[int, dict[str, tuple[float, float]]], dict[int, tuple[float, float]]]:
    """Of each frame: its slices; when it was due and its result received, s."""
    endpoint = f"tcp://127.0.0.1:{PORT}"
    trace = Trace("tactflow")
    with tempfile.TemporaryDirectory() as name, subscriber(endpoint) as process:
        folder = Path(name)
        write_pipeline(folder, SIZE, {"rate": RATE}, {"sinks": {"zmq": {"endpoint": endpoint}}})
        pipeline = load_pipeline(folder / "pipeline.yaml")
        Runner(pipeline, max_frames=FRAMES, trace=trace).run()
        received = json.loads(process.communicate(timeout=60)[0])
    slices: dict[int, dict[str, tuple[float, float]]] = defaultdict(dict)
    for track in trace.tracks:
        for part, began, ended, shown in track.slices:
            if not part.startswith("frame "):
                slices[shown["seq"]][part] = (began, ended)
    return slices, {seq: (due, when) for seq, due, when in received if seq >= SETTLED}


def parts(slices: Slices, due: float, received: float) -> list[float]:
    """The time of each of `PARTS` for one frame, s; their sum is the result's age."""
    captured = slices["capture"][1]
    sending = slices["zmq"]
    stages = [span for part, span in slices.items() if part not in ("capture", "zmq")]
    began, ended = min(span[0] for span in stages), max(span[1] for span in stages)
    worked = sum(span[1] - span[0] for span in stages)
    return [
        captured - due,
        began - captured,
        worked,
        ended - began - worked,
        sending[0] - ended,
        sending[1] - sending[0],
        received - sending[1],
    ]


def least(length: int) -> list[tuple[float, float, float]]:
    """A program that wakes and sends as much, without a pipeline: due, sent and received of each, s."""
    endpoint = f"tcp://127.0.0.1:{PORT + 1}"
    context = zmq.Context()
    socket = context.socket(zmq.PUB)
    socket.bind(endpoint)
    sent: dict[int, float] = {}
    with subscriber(endpoint) as process:
        never = threading.Event()
        began = time.perf_counter()
        for seq in range(FRAMES):
            due = began + seq / RATE
            never.wait(max(0.0, due - time.perf_counter()))
            body = {"seq": seq, "t": due, "filled": "x" * length}
            socket.send(TOPIC + json.dumps(body).encode())
            sent[seq] = time.perf_counter()
        received = json.loads(process.communicate(timeout=60)[0])
    context.destroy(linger=0)
    return [(due, sent[seq], when) for seq, due, when in received if seq >= SETTLED]


def computing(recording: Path, pause: float) -> float:
    """CPU time of a frame with contact, the median, ms, with a pause between frames, s."""
    pipeline = load_pipeline(REPOSITORY / "pipeline.yaml")
    run = LockstepPipeline(on_recording(pipeline, recording), None)
    times: list[float] = []
    while outcomes := run.block(1 if pause else BLOCK):
        times += [one.cpu for one in outcomes if one.contact is not None]
        time.sleep(pause)
    run.close()
    return 1e3 * float(np.median(times))


def with_pauses() -> str:
    """What a frame costs if others, or nothing, ran before it."""
    scene = open_scene(f"press?frames={PAUSED_FRAMES}")
    with tempfile.TemporaryDirectory() as name:
        recording = Path(name) / "press.npy"
        np.save(recording, np.stack([scene.frame(index) for index in range(PAUSED_FRAMES)]))
        took = [computing(recording, 1e-3 * pause) for pause in PAUSES]
    told = ", ".join(f"{ms:.2f} ms with {pause}" for ms, pause in zip(took, PAUSES, strict=True))
    return (
        "The same frames from a recording, CPU time of all stages but the publisher, by the pause between "
        f"two of them, ms: {told}."
    )


def report() -> str:
    """The section."""
    slices, times = run()
    rows: dict[bool, list[list[float]]] = {True: [], False: []}
    for seq, (due, received) in times.items():
        rows["hull" in slices[seq]].append(parts(slices[seq], due, received))
    touched, idle = (1e3 * np.array(rows[kind]) for kind in (True, False))
    bare = 1e3 * np.array([received - due for due, _, received in least(4000)])
    middle = np.median(touched, axis=0), np.median(idle, axis=0)
    lines = [f"| {part} | {a:.2f} | {b:.2f} |" for part, a, b in zip(PARTS, *middle, strict=True)]
    return "\n".join(
        [
            f"One sensor of {SIZE[0]} x {SIZE[1]} px at {RATE:g} frames a second, `press`, the default "
            f"pipeline, from the moment a frame was due to its result at a subscriber in another process; "
            f"medians of {len(touched)} frames with contact and {len(idle)} without one, ms:",
            "",
            "| part | contact | none |",
            "| --- | --- | --- |",
            *lines,
            f"| all, median | {_percentile(touched, 50)} | {_percentile(idle, 50)} |",
            f"| all, 99 of 100 | {_percentile(touched, 99)} | {_percentile(idle, 99)} |",
            "",
            f"A program that does nothing but wake and send 4 kB takes {np.median(bare):.2f} ms in the "
            f"median, {np.percentile(bare, 99):.2f} in 99 of 100.",
            "",
            with_pauses(),
        ]
    )


def _percentile(times: np.ndarray, part: float) -> str:
    return f"{np.percentile(times.sum(axis=1), part):.2f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the section."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--subscribe", help=argparse.SUPPRESS)
    args = parser.parse_args(arguments)
    if args.subscribe:
        subscribe(args.subscribe, FRAMES)
    else:
        # As the program does.
        gc.freeze()
        write_section("age", report(), PAGE)


if __name__ == "__main__":
    main()
