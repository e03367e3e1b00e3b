"""The sink `shm` and `SharedReader`: pictures of a run in shared memory, read by other processes."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tactflow
from tactflow import Frame, Result, SharedReader
from tactflow.engine.errors import StageError
from tactflow.plugins.shm.layout import RING, SLOT
from tactflow.plugins.shm.sink import Shm
from tactflow.vision.types import Depth, Flow
from tests.clock import PATIENCE, until
from tests.paths import REPOSITORY

HERE = Path(__file__).parent
PORTS = ("raw", "image", "unmarked", "annotated", "contact_mask", "field", "markers")
MAPS = Path("/proc/self/maps")
_names = count()


@pytest.fixture
def sensor() -> str:
    """A name that no other test uses."""
    return f"test{os.getpid()}_{next(_names)}"


@pytest.fixture
def opened(stack: ExitStack, sensor: str) -> Callable[..., Shm]:
    """Makes sinks that wait for readers."""

    def make(*ports: str, **params: Any) -> Shm:
        sink = Shm(Shm.Params(ports=ports or ("raw",), **params), sensor)
        sink.open()
        stack.callback(sink.close)
        return sink

    return make


@pytest.fixture
def reading(stack: ExitStack, sensor: str) -> Callable[..., SharedReader]:
    """Makes readers; returns once the sink knows of them."""

    def make(sink: Shm | None = None, port: str = "raw", **options: Any) -> SharedReader:
        before = sink.counters()["readers"] if sink else 0
        reader = stack.enter_context(SharedReader(sensor, port, **{"timeout": PATIENCE, **options}))
        if sink is not None:
            until(lambda: sink.counters()["readers"] > before)
        return reader

    return make


def result(seq: int, size: tuple[int, ...] = (6, 8, 3), **values: Any) -> Result:
    """A frame of one grey level, its seq modulo 251."""
    return Result(Frame("gel", seq, seq / 60, np.full(size, seq % 251, np.uint8)), values)


def test_every_port_has_the_values_of_the_run_and_its_message(sensor: str) -> None:
    sink = {"use": "shm", "ports": [*PORTS, "mask"], "in": {"mask": "marker_mask.marker_mask"}, "slots": 80}
    settings = {"sensor": sensor, "sinks": {"shared": sink | {"wait_for_reader": PATIENCE}}}

    def read(port: str) -> list[Any]:
        with SharedReader(sensor, port, latest=False, timeout=PATIENCE) as reader:
            return [picture.copy() for picture in takewhile(lambda picture: picture.seq < 39, reader)]

    with ThreadPoolExecutor(len(PORTS) + 1) as pool:
        reading = {port: pool.submit(read, port) for port in (*PORTS, "mask")}
        stream = tactflow.stream(source="sim:press?frames=40", settings=settings, images=True, sinks=True)
        runs = {run.seq: run for run in stream}
    for port, pictures in reading.items():
        # The run waits for its first reader, and others may miss some frames.
        assert len(pictures.result()) > 5
        for picture in pictures.result():
            run = runs[picture.seq]
            values = {**run, "raw": run.frame.image, "mask": run["marker_mask"]}
            assert (picture.t, picture.message["contact"]) == (run.t, run.to_dict()["contact"])
            if port == "annotated":  # which the stream does not keep
                assert picture.array.shape == run.image.shape
                continue
            expected = values[port]
            if port == "markers":
                expected = np.hstack([expected.origin, expected.displacement])
            if port == "field":
                assert (picture.array is None) == (run.contact is None)
                expected = picture.array if run.contact is None else expected.displacement
            assert np.array_equal(picture.array, expected)


def test_a_depth_map_is_its_heights_and_absent_without_contact(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    sink = opened("depth", "normals")
    depths, normals = (reading(sink, port, latest=False) for port in ("depth", "normals"))
    heights, up = np.random.default_rng(1).random((6, 8), np.float32), np.zeros((6, 8, 3), np.float32)
    sink.write(result(0))
    sink.write(result(1, depth=Depth(heights, 1.0, None, 0.0, None), normals=up))
    sink.write(result(2))
    assert depths.read().array is None
    assert np.array_equal(depths.read().array, heights)
    assert [depths.read().array, normals.read().array] == [None, None]
    assert normals.read().array.dtype == np.float32
    assert normals.find(1).result.seq == 1


@pytest.mark.parametrize("slots", [3, 8])
def test_a_picture_is_valid_until_it_may_be_overwritten_and_a_copy_for_ever(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader], slots: int
) -> None:
    sink = opened(slots=slots)
    reader = reading(sink)
    sink.write(result(1))
    picture = reader.read()
    assert not picture.array.flags.writeable
    copied = picture.copy()
    for seq in range(2, slots):
        sink.write(result(seq))
        assert picture.valid
    sink.write(result(slots))
    # It is withdrawn while its bytes are still there: the next frame overwrites them.
    assert not picture.valid
    assert (picture.array == 1).all()
    sink.write(result(slots + 1))
    assert (picture.array != 1).all()
    assert copied.valid
    assert (copied.array == 1).all()
    assert picture.message["seq"] == 1
    with pytest.raises(BufferError, match=rf"picture 1 has been overwritten.* \(now {slots}\)"):
        picture.copy()


def test_a_reader_takes_the_newest_or_all_that_are_left_and_counts_the_others(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    sink = opened(slots=8)
    newest, ordered = reading(sink), reading(sink, latest=False)
    sink.write(result(0))
    assert [newest.read().seq, ordered.read().seq] == [0, 0]
    for seq in range(1, 21):
        sink.write(result(seq))
    assert [newest.read().seq, newest.lost] == [20, 19]
    assert [ordered.read().seq for _ in range(7)] == list(range(14, 21))
    assert ordered.lost == 13
    assert ordered.find(14).seq == 14
    assert ordered.find(13) is None


def test_readers_follow_to_larger_arrays_and_messages_without_losing_any(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    sink = opened()
    reader = reading(sink, latest=False)
    sizes = [(6, 8, 3), (4, 4, 3), (60, 80, 3), (60, 80, 3), (120, 80, 3)]
    for seq, size in enumerate(sizes):
        sink.write(result(seq, size))
    long = Result(Frame("gel" * 60_000, 5, 0.0, np.zeros((2, 2, 3), np.uint8)))
    sink.write(long)
    pictures = [reader.read() for _ in range(6)]
    assert [picture.array.shape for picture in pictures] == [*sizes, (2, 2, 3)]
    assert all(picture.valid and (picture.array == picture.array[0, 0, 0]).all() for picture in pictures)
    assert pictures[-1].message == long.to_dict()
    assert len({picture.generation for picture in pictures}) == 4
    assert reader.lost == 0


def test_without_readers_nothing_is_computed_and_no_memory_taken(sensor: str) -> None:
    settings = {"sensor": sensor, "sinks": {"shm": {"ports": ["annotated"]}}}
    run = tactflow.run(source="sim:press?frames=30", settings=settings)
    assert run.stats["sinks"]["shm"]["counters"] == {"shared": 0, "readers": 0}
    assert run.stats["stages"]["visualize"]["runs"] == 0


def test_a_reader_that_never_reads_holds_nobody_up(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    sink = opened()
    lazy = reading(sink)
    for seq in range(5000):
        sink.write(result(seq, (2, 2, 3)))
    assert sink.counters()["shared"] == 5000
    assert lazy.read().seq == 4999
    sink.write(result(5000))
    assert lazy.read().array.shape == (6, 8, 3)


def test_memory_is_given_back_when_the_last_reader_leaves(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    if not MAPS.exists():
        pytest.skip("only Linux lists the memory of a process")

    def count_maps() -> int:
        return MAPS.read_text().count("memfd:tactflow")

    sink = opened()
    before = count_maps()
    for seq in range(3):
        with reading(sink) as reader:
            sink.write(result(seq))
            assert reader.read().seq == seq
            assert count_maps() == before + 2  # the writer's and the reader's
        until(lambda: count_maps() == before)
        sink.write(result(seq))
        assert count_maps() == before


def test_a_wrong_port_name_or_timeout_is_an_error_that_says_what_to_do(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader], sensor: str
) -> None:
    opened("raw", "image")
    with pytest.raises(StageError, match=rf"{sensor}: the port depht is not shared, but raw, image; list it"):
        reading(None, "depht").read()
    with pytest.raises(TimeoutError, match=r"no picture of nobody, image, for 0 s; is tactflow running with"):
        SharedReader("nobody", timeout=0).read()
    with pytest.raises(ValueError, match=r"timeout: required None or 0 to 1e\+06 seconds, got -1"):
        SharedReader("nobody", timeout=-1)
    with pytest.raises(AttributeError, match=r"public are .*, SharedReader$"):
        tactflow.SharedWriter  # noqa: B018


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ports": ["anotated"]}, r"needs anotated, which no stage gives"),
        ({"ports": ["a b"]}, r"required names of ports, got 'a b'"),
        ({"ports": ["raw", "raw"]}, r"required each port once"),
        ({"ports": []}, r"ports"),
        ({"slots": 2}, r"slots"),
        ({"ports": ["mask"], "in": {"mask": "hull.mask"}}, r"hull .*has no output 'mask'"),
    ],
)
def test_a_mistake_in_the_pipeline_file_is_reported_before_the_run(
    values: dict[str, Any], message: str
) -> None:
    (mistake,) = tactflow.check(settings={"sinks": {"shm": values}})
    assert re.search(message, mistake)


def test_a_port_without_an_array_is_an_error_with_a_remedy(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    sink = opened("flow", "odd")
    reading(sink, "flow")
    with pytest.raises(StageError, match=r"flow: required an array, got Flow; the message has its values"):
        sink.write(result(0, flow=Flow((0.0, 0.0), 3)), None)
    reading(sink, "odd")
    with pytest.raises(StageError, match=r"odd: required an array of numbers with 4 axes at most, got 5"):
        sink.write(result(0), np.zeros((1, 1, 1, 1, 1)))


def test_two_runs_cannot_share_one_sensor(opened: Callable[..., Shm], tmp_path: Path) -> None:
    for path in (None, str(tmp_path / "gel.sock")):
        first = opened(socket=path)
        with pytest.raises(StageError, match=r"cannot share pictures at .*: another run"):
            opened(socket=path)
        first.close()
        opened(socket=path)


def test_a_socket_in_a_file_is_for_its_owner_and_does_not_outlive_the_run(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader], tmp_path: Path
) -> None:
    path = tmp_path / "gel.sock"
    path.touch()  # as one that was killed left it
    sink = opened(socket=str(path))
    reader = reading(sink, socket=str(path))
    sink.write(result(3))
    assert reader.read().seq == 3
    assert path.stat().st_mode & 0o777 == 0o600
    sink.close()
    assert not list(tmp_path.iterdir())
    with pytest.raises(StageError, match=r"cannot share pictures at .*missing.*No such file"):
        opened(socket=str(tmp_path / "missing" / "gel.sock"))


def test_a_reader_waits_for_a_run_and_goes_on_with_the_next_one(
    opened: Callable[..., Shm], reading: Callable[..., SharedReader]
) -> None:
    reader = reading(None, latest=False)
    generations = []
    for run in range(3):
        sink = opened()
        until(lambda sink=sink: reader.find(-1) or sink.counters()["readers"])
        for seq in range(3):
            sink.write(result(seq + run))
        sink.close()
        pictures = [reader.read() for _ in range(3)]
        assert [picture.seq for picture in pictures] == [run, run + 1, run + 2]
        assert all((picture.array == picture.seq).all() and picture.valid for picture in pictures)
        generations.append(reader.generation)
    assert sorted(set(generations)) == generations


class Forker:
    """Forks writers and readers, and kills them."""

    def __init__(self) -> None:
        command = [sys.executable, str(HERE / "forker.py")]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def _ask(self, *words: object) -> int:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(*words, file=self._process.stdin, flush=True)
        return int(self._process.stdout.readline())

    def start(self, role: str, sensor: str) -> int:
        return self._ask(role, sensor)

    def kill(self, process: int) -> None:
        os.kill(process, signal.SIGKILL)
        self._ask("reap", process)

    def close(self) -> None:
        self._process.communicate(timeout=PATIENCE)


@pytest.fixture(scope="module")
def forker() -> Iterator[Forker]:
    forker = Forker()
    yield forker
    forker.close()


def assert_whole(picture: Any) -> None:
    """Each pixel and the message are of the same frame."""
    assert (picture.array == picture.seq % 251).all()
    assert picture.message["seq"] == picture.seq


def left_behind(sensor: str) -> list[str]:
    """Names of shared memory and sockets of this sensor."""
    files = [path for place in ("/dev/shm", "/tmp") for path in Path(place).glob(f"*{sensor}*")]
    sockets = Path("/proc/net/unix")
    return [*map(str, files), *re.findall(rf"\S*{sensor}\b", sockets.read_text() if sockets.exists() else "")]


KILLS = [10, pytest.param(100, marks=pytest.mark.slow)]


@pytest.mark.parametrize("kills", KILLS)
def test_a_writer_killed_at_any_moment_leaves_no_torn_picture_and_no_memory(
    forker: Forker, reading: Callable[..., SharedReader], sensor: str, kills: int
) -> None:
    moments = random.Random(kills)
    reader = reading(timeout=0)
    seen: list[Any] = []
    generations = set()

    def is_there() -> bool:
        """Whether there is a picture; its whole copy is kept."""
        with suppress(TimeoutError, BufferError):
            seen.append(reader.read().copy())
            assert_whole(seen[-1])
            return True
        return False

    for _ in range(kills):
        writer = forker.start("writer", sensor)
        for _ in range(moments.randint(1, 8)):
            until(is_there)
        time.sleep(moments.random() * 0.01)
        forker.kill(writer)
        until(lambda: not is_there() and not reader.connected)
        # All that the ring still holds; the picture that was being written has no stamp.
        rest = [reader.find(seen[-1].seq - back) for back in range(8)]
        for picture in filter(None, rest):
            assert_whole(picture.copy())
        assert rest[0]
        generations.add(reader.generation)
        assert left_behind(sensor) == []
    assert len(generations) == kills


@pytest.mark.parametrize("kills", KILLS)
def test_a_reader_killed_at_any_moment_disturbs_nobody(
    forker: Forker, opened: Callable[..., Shm], reading: Callable[..., SharedReader], sensor: str, kills: int
) -> None:
    moments = random.Random(kills)
    sink = opened()
    witness = reading(sink, latest=False)
    seq = 0
    for _ in range(kills):
        victim = forker.start("reader", sensor)
        until(lambda: sink.counters()["readers"] == 2)
        for _ in range(moments.randint(1, 20)):
            sink.write(result(seq))
            picture = witness.read()
            assert picture.seq == seq
            assert_whole(picture.copy())
            seq += 1
        forker.kill(victim)
        until(lambda: sink.counters()["readers"] == 1)
    assert witness.lost == 0
    sink.close()
    assert left_behind(sensor) == []


@pytest.fixture(scope="module")
def c_reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program in C that knows the header alone."""
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("there is no C compiler")
    program = tmp_path_factory.mktemp("c") / "reader"
    flags = ["-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{REPOSITORY / 'docs'}"]
    subprocess.run([compiler, *flags, str(HERE / "reader.c"), "-o", str(program)], check=True)
    return program


@pytest.mark.parametrize("in_file", [False, True], ids=["without a file", "socket in a file"])
def test_a_reader_in_c_sees_the_same(
    c_reader: Path, opened: Callable[..., Shm], sensor: str, tmp_path: Path, in_file: bool
) -> None:
    path = str(tmp_path / "gel.sock") if in_file else None
    arguments = [str(c_reader), sensor, "depth", "5", *([path] if path else [])]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        layout: list[list[str]] = []
        sink = opened("depth", socket=path)
        assert sink.wait_for_reader(PATIENCE)
        for size in (0, 6, 6, 40, 0):
            heights = np.arange(size * 8, dtype=np.float32).reshape(size, 8)
            values = {"depth": Depth(heights, 1.0, None, 0.0, None)} if size else {}
            shared = result(seq := sink.counters()["shared"] + 30, **values)
            sink.write(shared)
            while not (line := program.stdout.readline()).startswith("picture"):
                layout.append(line.split())
            expected = (
                f"{seq} {seq / 60:.3f} {'<f4' if size else 'absent'} {size} {heights.view(np.uint8).sum()}"
            )
            assert line == f"picture {expected} 1 {shared.to_json()}\n"
    assert program.returncode == 0
    for name, dtype in (("ring", RING), ("slot", SLOT)):
        assert [[f"{name}.{key}", str(dtype.fields[key][1])] for key in dtype.names] == [
            line for line in layout if line[0].startswith(name)
        ]


def test_the_program_in_c_of_the_documentation_compiles(c_reader: Path, tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "shared-memory.md").read_text()
    (program,) = re.findall(r"```c\n(.*?)```", page, re.S)
    (tmp_path / "watch.c").write_text(program)
    compiler = shutil.which("gcc") or shutil.which("clang")
    flags = ["-std=c11", "-Wall", "-Werror", "-fsyntax-only", f"-I{REPOSITORY / 'docs'}"]
    assert c_reader.exists()
    assert compiler is not None
    subprocess.run([compiler, *flags, str(tmp_path / "watch.c")], check=True)


def test_a_reader_in_c_is_told_why_it_gets_nothing(
    c_reader: Path, opened: Callable[..., Shm], sensor: str
) -> None:
    opened("raw")
    done = subprocess.run([str(c_reader), sensor, "depth", "1"], capture_output=True, text=True, check=True)
    assert "refused the port depth is not shared, but raw; list it in sinks.shm.ports" in done.stdout
