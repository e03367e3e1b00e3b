"""A running tactflow with subscribers and pages, and what it takes meanwhile."""

from __future__ import annotations

import json
import mmap
import re
import shutil
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
import zmq
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tactflow.sim import open_scene
from tests.conftest import REPOSITORY

CYCLE = 60
"""Pictures that are shown again and again: one press and release."""
PAGE = REPOSITORY / "docs" / "reliability.md"
_SEQ = re.compile(rb'"seq":(\d+)')
_T = re.compile(rb'"t":([\d.e+]+)')


@dataclass(frozen=True, slots=True)
class Sample:
    """What a process holds. memory : MB. files : open descriptors."""

    memory: float
    files: int
    threads: int


def sample(pid: int) -> Sample | None:
    """A look at a process; None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        return Sample(
            int((folder / "statm").read_text().split()[1]) * mmap.PAGESIZE / 2**20,
            len(list((folder / "fd").iterdir())),
            len(list((folder / "task").iterdir())),
        )
    except (OSError, IndexError):
        return None


def children(pid: int) -> list[int]:
    """The processes that a process has started."""
    with suppress(OSError):
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def write_pipeline(
    folder: Path, size: tuple[int, int], source: Mapping[str, Any], changes: Mapping[str, Any]
) -> None:
    """The default pipeline with the endless source, its pictures beside it.

    size : (width, height) of the pictures, px. source : parameters of the source. changes : keys of the file
    that are replaced.
    """
    scene = open_scene(f"press?frames={CYCLE}")
    pictures = [cv2.resize(scene.frame(i), size, interpolation=cv2.INTER_AREA) for i in range(CYCLE)]
    np.save(folder / "pictures.npy", np.stack(pictures))
    shutil.copy(Path(__file__).with_name("endless.py"), folder)
    document = yaml.safe_load((REPOSITORY / "pipeline.yaml").read_text(encoding="utf-8"))
    pictures_file = str(folder / "pictures.npy")
    document["stages"]["capture"] = {"use": "./endless.py:Endless", "pictures": pictures_file, **source}
    if "sensors" in changes:
        del document["sensor"]
    document |= changes
    (folder / "pipeline.yaml").write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")


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


@dataclass
class Subscribers:
    """Reads what is published at an address, over several connections.

    Attributes
    ----------
    ages : age of each result when it arrived, s, for live sources. seqs : sensor -> numbers that the first
    connection got. statistics : the newest message of statistics.
    """

    endpoint: str
    count: int = 1
    ages: list[float] = field(default_factory=list[float])
    seqs: dict[bytes, list[int]] = field(default_factory=dict[bytes, list[int]])
    statistics: dict[str, Any] = field(default_factory=dict[str, Any])
    keep: bool = False

    @contextmanager
    def reading(self) -> Iterator[Subscribers]:
        """Reads in a thread of its own while the block lasts."""
        end = threading.Event()
        thread = threading.Thread(target=self._read, args=(end,))
        thread.start()
        try:
            yield self
        finally:
            end.set()
            thread.join()

    def _read(self, end: threading.Event) -> None:
        with ExitStack() as stack:
            context = stack.enter_context(zmq.Context())
            poller = zmq.Poller()
            first = None
            for _ in range(self.count):
                socket = stack.enter_context(context.socket(zmq.SUB))
                socket.linger = 0
                socket.subscribe(b"tactflow.")
                socket.subscribe(b"tactflow.stats ")
                socket.connect(self.endpoint)
                poller.register(socket, zmq.POLLIN)
                first = first or socket
            while not end.is_set():
                for socket, _ in poller.poll(100):
                    self._take(socket.recv(), first=socket is first)

    def _take(self, message: bytes, *, first: bool) -> None:
        topic, _, body = message.partition(b" ")
        if topic == b"tactflow.stats":
            if first:
                self.statistics = json.loads(body)
            return
        seq, t = _SEQ.search(body), _T.search(body)
        if not self.keep or seq is None or t is None:
            return
        self.ages.append(time.perf_counter() - float(t[1]))
        if first:
            self.seqs.setdefault(topic, []).append(int(seq[1]))


@contextmanager
def pages(ports: Sequence[int], count: int) -> Iterator[list[int]]:
    """So many pages on each of some ports that show all they are sent; gives how many pictures each got."""
    got = [0] * (count * len(ports))
    sockets = []

    def drain(index: int, port: int) -> None:
        with suppress(ConnectionClosed, OSError):
            address = f"127.0.0.1:{port}"
            with connect(f"ws://{address}/live", compression=None, origin=f"http://{address}") as socket:  # type: ignore[arg-type]
                sockets.append(socket)
                for message in socket:
                    if isinstance(message, bytes):
                        got[index] += 1
                        # The next picture comes when this one is said to have been shown.
                        (length,) = struct.unpack_from("<I", message)
                        header = json.loads(message[4 : 4 + length])
                        socket.send(json.dumps({"ack": header["number"]}))

    threads = [
        threading.Thread(target=drain, args=(index, port), daemon=True)
        for index, port in enumerate(list(ports) * count)
    ]
    for thread in threads:
        thread.start()
    try:
        yield got
    finally:
        for socket in sockets:
            socket.close()
        for thread in threads:
            thread.join(5)


def write_section(name: str, text: str, path: Path = PAGE) -> None:
    """Replace one section of a page, of docs/reliability.md by default, between its two markers."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    page = path.read_text(encoding="utf-8")
    before, _, rest = page.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{path}: required the lines {begin} and {end}")
    path.write_text(f"{before}{begin}\n\n{text.strip()}\n\n{end}{after}", encoding="utf-8")
