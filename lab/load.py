"""Measure a running tactflow under load: age and loss of results, memory over time.

    python lab/load.py                       # 1 to 16 sensors, 1 to 128 subscribers; five minutes
    python lab/load.py --sensors 1 --rate 60
    python lab/load.py --sensors 16 --touched 2 --rate 60 --subscribers
    taskset -c 0 python lab/load.py --sensors 1 --rate 1000 --size 320 240 --subscribers
    python lab/load.py --soak 1000000        # frames through all sinks as fast as possible; an hour

Each sensor feeds pictures of 800 x 600 px (or `--size`), with intermittent contact or of an untouched gel, to
the default pipeline. Subscribers run on the same machine. Tables are printed in Markdown.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
import zmq

import tactflow

ROOT = Path(__file__).resolve().parents[1]
CYCLE_FRAMES = 60
"""Number of pictures in the repeated cycle: one press and release."""
PICTURES, IDLE = "press.npy", "idle.npy"
SETTLING_SECONDS, MEASURED_SECONDS = 4.0, 15.0
"""Seconds between the first results and the measurement, and duration of the measurement. Chosen by hand."""
SAMPLE_INTERVAL_S = 5.0
"""Interval between samples of a process's memory, s. Chosen by hand."""
PORT = 5750
"""Port of the publisher; the page has the next one."""
SIZE = (800, 600)
"""Width and height of a picture, px."""
SOAK_SIZE = (200, 150)
"""Width and height, px: small, so that a million frames take an hour; leaks per frame do not depend on the
size."""


def write_pipeline(folder: Path, size: tuple[int, int], source: Mapping[str, Any], **changes: Any) -> None:
    """Write the default pipeline with the endless source, its pictures, and changed keys."""
    for name in (PICTURES, IDLE):
        scene = tactflow.open_scene(f"{name.removesuffix('.npy')}?frames={CYCLE_FRAMES}")
        pictures = [
            cv2.resize(scene.frame(i), size, interpolation=cv2.INTER_AREA) for i in range(CYCLE_FRAMES)
        ]
        np.save(folder / name, np.stack(pictures))
    shutil.copy(Path(__file__).with_name("endless.py"), folder)
    document = yaml.safe_load((ROOT / "pipeline.yaml").read_text(encoding="utf-8"))
    capture = {"use": "./endless.py:Endless", "pictures": str(folder / PICTURES), **source}
    document["stages"]["capture"] = capture
    if "sensors" in changes:
        del document["sensor"]
    (folder / "pipeline.yaml").write_text(
        yaml.safe_dump(document | changes, sort_keys=False), encoding="utf-8"
    )


@contextmanager
def running(folder: Path, *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """`tactflow run` in a folder, until the block ends."""
    command = [sys.executable, "-P", "-m", "tactflow", "run", "--quiet", *arguments]
    with (folder / "messages.txt").open("wb") as messages:
        process = subprocess.Popen(command, cwd=folder, stderr=messages, stdout=subprocess.DEVNULL)
        try:
            yield process
        finally:
            process.terminate()
            process.wait()


def fail_if_ended(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Exit with the messages of the process if it has ended."""
    if process.poll() is not None:
        raise SystemExit((folder / "messages.txt").read_text(encoding="utf-8"))


def family(pid: int) -> list[int]:
    """A process and its children."""
    return [pid, *map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())]


def processor_seconds(pid: int) -> float:
    """CPU time of a process and its children so far, s."""
    stats = [Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split() for one in family(pid)]
    return sum(int(fields[11]) + int(fields[12]) for fields in stats) / os.sysconf("SC_CLK_TCK")


def resources(pid: int) -> dict[str, float]:
    """Memory of a process and its children, MB, its open files and threads; empty if it has ended."""
    folder = Path(f"/proc/{pid}")
    with suppress(OSError, IndexError):
        pages = [int(Path(f"/proc/{one}/statm").read_text().split()[1]) for one in family(pid)]
        megabytes = sum(pages) * os.sysconf("SC_PAGE_SIZE") / 2**20
        files, threads = (len(list((folder / name).iterdir())) for name in ("fd", "task"))
        return {"memory, MB": megabytes, "open files": files, "threads": threads}
    return {}


class Subscribers:
    """Receives results over several connections. ages : s. seqs : by sensor, of the first connection."""

    def __init__(self, count: int) -> None:
        self.ages: list[float] = []
        self.seqs: defaultdict[str, list[int]] = defaultdict(list)
        self._count = count

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Receive in a thread for the duration of the block."""
        end = threading.Event()
        thread = threading.Thread(target=self._read, args=(end,))
        thread.start()
        try:
            yield
        finally:
            end.set()
            thread.join()

    def _read(self, end: threading.Event) -> None:
        with ExitStack() as stack:
            context, poller = stack.enter_context(zmq.Context()), zmq.Poller()
            sockets = [stack.enter_context(context.socket(zmq.SUB)) for _ in range(self._count)]
            for socket in sockets:
                socket.linger = 0
                socket.subscribe(b"tactflow.s")
                socket.connect(f"tcp://127.0.0.1:{PORT}")
                poller.register(socket, zmq.POLLIN)
            while not end.is_set():
                for socket, _ in poller.poll(100):
                    topic, _, body = socket.recv().partition(b" ")
                    if topic != b"tactflow.stats":
                        message = json.loads(body)
                        self.ages.append(time.perf_counter() - message["t"])
                        if socket is sockets[0]:
                            self.seqs[message["sensor"]].append(message["seq"])


def measure(
    sensors: int, subscribers: int, rate: float, touched: int, size: tuple[int, int] = SIZE
) -> list[str]:
    """Measure one load; return the cells of its row.

    touched : sensors with contacts, the first ones. size : width and height of the pictures, px.
    """
    readers = Subscribers(subscribers)
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        idle = {"stages": {"capture": {"pictures": str(folder / IDLE)}}}
        several = {f"s{n}": {} if n < touched else idle for n in range(sensors)}
        names = {"sensors": several} if sensors > 1 else {"sensor": "s0"}
        sinks = {"zmq": {"endpoint": f"tcp://127.0.0.1:{PORT}"}}
        write_pipeline(folder, size, {"rate": rate}, sinks=sinks, **names)
        # The dots of smaller pictures would be lost.
        whole = ("--set", "stages.preprocess.downsample=1") if size < SIZE else ()
        process = stack.enter_context(running(folder, *whole))
        stack.enter_context(readers.reading())
        while len(readers.seqs) < sensors:
            fail_if_ended(process, folder)
            time.sleep(0.1)
        time.sleep(SETTLING_SECONDS)
        readers.ages.clear()
        readers.seqs.clear()
        before, began, used = (
            resources(process.pid)["memory, MB"],
            time.perf_counter(),
            processor_seconds(process.pid),
        )
        time.sleep(MEASURED_SECONDS)
        busy = (processor_seconds(process.pid) - used) / (time.perf_counter() - began)
        memory = resources(process.pid)["memory, MB"]
        ages = 1e3 * np.array(readers.ages)
        arrived = [len(seqs) / (seqs[-1] - seqs[0] + 1) for seqs in readers.seqs.values()]
    p50, p99 = np.percentile(ages, (50, 99))
    cells = [f"{sensors}", f"{subscribers}", f"{100 * np.mean(arrived):.1f} %", f"{p50:.2f}", f"{p99:.1f}"]
    return [
        *cells,
        f"{ages[-max(1, len(ages) // 10) :].max():.0f}",
        f"{memory:.0f}",
        f"{memory - before:+.1f}",
        f"{busy:.2f}",
    ]


def soak(frames: int, folder: Path) -> list[dict[str, float]]:
    """Run frames through all sinks; return samples of the process's resources."""
    sinks = {
        "zmq": {"endpoint": f"tcp://127.0.0.1:{PORT}"},
        "jsonl": {"path": "results.jsonl"},
        "record": {"path": "recording.mcap", "rotate_after": 60},
        "images": {"folder": "images", "format": "jpg", "max_rate": 1},
        "video": {"path": "annotated.mkv", "fps": 60},
        "view": {"port": PORT + 1},
    }
    write_pipeline(folder, SOAK_SIZE, {"frames": frames}, sinks=sinks, sensor="s0")
    samples = []
    with running(folder, "--set", "stages.preprocess.downsample=1") as process, Subscribers(1).reading():
        while process.poll() is None:
            samples.append(resources(process.pid))
            for old in sorted(folder.glob("recording*.mcap"), key=os.path.getmtime)[:-2]:
                old.unlink()
            time.sleep(SAMPLE_INTERVAL_S)
    if process.returncode:
        fail_if_ended(process, folder)
    with (folder / "results.jsonl").open("rb") as lines:
        count = sum(1 for _ in lines)
    if count != frames:
        raise SystemExit(f"required {frames} lines, got {count}")
    # The last sample shows a process that is shutting down.
    return [sample for sample in samples if sample][:-1]


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a table in Markdown."""
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description="Measure a running tactflow under load.")
    parser.add_argument("--sensors", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument(
        "--touched", type=int, default=sys.maxsize, metavar="N", help="the other sensors see an untouched gel"
    )
    parser.add_argument(
        "--subscribers", type=int, nargs="*", default=[16, 128], help="number, with one sensor"
    )
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second of each sensor (30)")
    parser.add_argument(
        "--soak", type=int, metavar="FRAMES", help="measure memory over this number of frames instead"
    )
    parser.add_argument(
        "--size", type=int, nargs=2, default=SIZE, metavar=("WIDTH", "HEIGHT"), help="of the pictures, px"
    )
    args = parser.parse_args()
    if args.soak:
        with tempfile.TemporaryDirectory() as folder:
            samples = soak(args.soak, Path(folder))
        print_row(["", "after a tenth", "least since", "most since", "at the end"])
        print_row(["---"] * 5)
        for what in samples[0]:
            values = [sample[what] for sample in samples[len(samples) // 10 :]]
            print_row([what, *(f"{v:.0f}" for v in (values[0], min(values), max(values), values[-1]))])
        return
    heads = ["sensors", "subscribers", "results", "age, ms: p50", "p99", "oldest at the end", "memory, MB"]
    print_row([*heads, "growth, MB", "processors busy"])
    print_row(["---"] * 9)
    for sensors, subscribers in [(n, 1) for n in args.sensors] + [(1, n) for n in args.subscribers]:
        print_row(measure(sensors, subscribers, args.rate, args.touched, tuple(args.size)))


if __name__ == "__main__":
    main()
