"""Several sensors: one process for each, under one supervisor.

Each process runs the pipeline for its sensor. What they publish over ZeroMQ comes out at the one address
that the pipeline names: the supervisor binds it and passes messages on, and subscriptions back, so that a
process still knows whether anybody listens. A process that fails is started again with a growing pause;
the others go on.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, NamedTuple

import zmq

from tactflow.config.sensors import PLACEHOLDER
from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.run import INTERRUPTED
from tactflow.files import expanded, is_device, lead_nowhere, output, status

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
GIVE_UP_AFTER = 5
"""Failures in a row after which a sensor is not started again."""
GOOD_RUN = 30.0
"""A process that ran so long, s, starts with the first pause again when it fails."""
STREAMS = ("/dev/stdout", "/dev/stderr")
"""They lead to the supervisor, even where what they stand for is a regular file just now."""


def run_fleet(args: argparse.Namespace, file: Path, pipelines: Mapping[str, Pipeline]) -> int:
    """Run every sensor's pipeline in a process of its own until all have ended.

    args : as `tactflow run` got them. file : the pipeline file. pipelines : sensor -> its pipeline, checked.

    Returns
    -------
    0 if all ended well, 130 after a second signal, else the exit code of the first sensor that was given up.

    Raises
    ------
    ConfigError : several sensors would write one file or read one source, or an option names no file.
    StageError : the address for subscribers is taken.
    """
    problems = [*_option_problems(args, list(pipelines)), *clash_problems(pipelines)]
    if problems:
        raise ConfigError("\n".join(problems))
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactflow-")))
        relays = _relays(pipelines)
        for endpoint, ids in relays.items():
            upstream = [_private(scratch, name, id_) for name, id_ in ids]
            backlog = sum(getattr(pipelines[name].nodes[id_].params, "backlog", 1) for name, id_ in ids)
            stack.enter_context(_relay(endpoint, upstream, backlog))
        members = []
        for name in pipelines:
            private = [
                f"sinks.{id_}.endpoint={_private(scratch, name, id_)}"
                for ids in relays.values()
                for sensor, id_ in ids
                if sensor == name
            ]
            # Their pages show a tab for each other.
            private += [
                f"sinks.{node.id}.neighbours={scratch}"
                for node in pipelines[name].sinks
                if node.component.name == "view"
            ]
            private += _added_sinks(args, pipelines[name], name)
            command = _command(args, file, name, private)
            members.append(_Member(name, command, _outputs(args, pipelines[name], name)))
        return _Supervisor(members).run()


def with_name(path: str, sensor: str) -> str:
    """The file that one sensor's process writes where the command line names `path` for all of them.

    Standard output and devices are the same for all.

    Raises
    ------
    ConfigError : it is a folder.
    """
    if path == "-" or path in STREAMS or is_device(path):
        return path
    named = path.replace(PLACEHOLDER, sensor)
    if named == path and not _is_folder(path):
        whole = Path(path)
        named = str(whole.with_name(f"{whole.stem}-{sensor}{whole.suffix}"))
    if _is_folder(named):
        example = os.path.join(named, f"{PLACEHOLDER}.json")
        raise ConfigError(f"required a file, not a folder; each sensor writes its own, as in {example}")
    return named


def _is_folder(path: str) -> bool:
    return os.path.basename(path) in ("", ".", "..") or expanded(path).is_dir()


def _command(args: argparse.Namespace, file: Path, sensor: str, overrides: Sequence[str]) -> list[str]:
    verb = "run" if getattr(args, "out", None) is None else "record"
    command = [sys.executable, "-m", "tactflow", verb, str(file), "--sensor", sensor]
    for text in (*args.overrides, *overrides):
        command += ["--set", text]
    for option in ("stats", "trace", "out"):
        path = getattr(args, option, None)
        if path is not None:
            command += [f"--{option}", with_name(str(path), sensor)]
    if args.max_frames is not None:
        command += ["--max-frames", str(args.max_frames)]
    if args.stats_every is not None:
        command += ["--stats-every", str(args.stats_every)]
    flags = ("realtime", "quiet", "check", "overwrite", "number")
    command += [f"--{flag}" for flag in flags if getattr(args, flag, False)]
    return command


def _added_sinks(args: argparse.Namespace, pipeline: Pipeline, sensor: str) -> list[str]:
    """The sinks of `--jsonl` as overrides, so that a later override may change them."""
    return [
        f"sinks.{node.id}={{use: jsonl, path: {json.dumps(_path_of(node, args, sensor))}}}"
        for node in pipeline.sinks
        if _is_added(node, "jsonl")
    ]


def _is_added(node: Node, option: str) -> bool:
    """Whether this option of the command line added the sink."""
    return str(node.mark) == f"--{option}"


def _path_of(node: Node, args: argparse.Namespace, sensor: str) -> str:
    """Where a sink writes in the process of one sensor."""
    if _is_added(node, "jsonl"):
        return with_name(args.jsonl, sensor)
    return str(getattr(node.params, "path", "-"))


class _State(NamedTuple):
    """What tells whether somebody has written to a file."""

    device: int
    inode: int
    size: int
    modified_ns: int


def _state(path: str) -> _State | None:
    """The present state of a regular file; None if there is none."""
    there = status(path)
    if there is None or not stat.S_ISREG(there.st_mode):
        return None
    return _State(there.st_dev, there.st_ino, there.st_size, there.st_mtime_ns)


@dataclass(frozen=True, slots=True)
class _Output:
    """A file that the processes of a sensor write.

    path : the file. before : its state before the first process. guarded : whether the user has not allowed
    to replace or continue it. keep : options that make a process keep what is in it.
    """

    path: str
    before: _State | None
    guarded: bool
    keep: tuple[str, ...] = ()

    @property
    def begun(self) -> bool:
        """Whether a process has written to it."""
        return _state(self.path) not in (None, self.before)

    @property
    def refused(self) -> bool:
        """Whether a process that is started now may not write to it."""
        now = _state(self.path)
        return self.guarded and now is not None and now.size > 0 and not (self.keep and self.begun)


def _outputs(args: argparse.Namespace, pipeline: Pipeline, sensor: str) -> list[_Output]:
    """The files whose content matters when a sensor is started again."""
    found = []
    for node in pipeline.sinks:
        path = _path_of(node, args, sensor)
        if node.component.name not in ("jsonl", "video") or path == "-":
            continue
        guarded = not any(getattr(node.params, name, False) for name in ("overwrite", "append"))
        keep: tuple[str, ...] = ()
        if node.component.name == "jsonl":
            where = f"sinks.{node.id}"
            keep = ("--set", f"{where}.overwrite=false", "--set", f"{where}.append=true")
        found.append(_Output(path, _state(path), guarded, keep))
    recording = getattr(args, "out", None)
    if recording is not None:
        path = with_name(str(recording), sensor)
        found.append(_Output(path, _state(path), not (args.overwrite or args.number), ("--number",)))
    return found


def _again(command: Sequence[str], outputs: Sequence[_Output]) -> list[str]:
    """The command that starts a sensor after a failure: what it has written so far must stay.

    For a file to which it has not come yet, what the user wants still holds.
    """
    added = [word for output in outputs if output.begun for word in output.keep]
    if "--number" in added:
        command = [word for word in command if word not in ("--overwrite", "--number")]
    return [*command, *added]


def _option_problems(args: argparse.Namespace, sensors: Sequence[str]) -> list[str]:
    """What is wrong with the command line of a run of several sensors."""
    problems = []
    if args.source is not None:
        problems.append(
            f"--source: the pipeline has {len(sensors)} sensors, each with its own source; choose one with "
            f"--sensor {sensors[0]}, or use --set sensors.NAME.stages.capture.source=..."
        )
    for option in ("jsonl", "stats", "trace", "out"):
        path = getattr(args, option, None)
        try:
            for sensor in sensors if path is not None else ():
                with_name(str(path), sensor)
        except ConfigError as error:
            problems.append(f"--{option} {path}: {error}")
    return problems


def clash_problems(pipelines: Mapping[str, Pipeline]) -> list[str]:
    """One message for each sink of a pipeline file that would write where another sensor's does.

    pipelines : sensor -> its pipeline.
    """
    problems = []
    seen: dict[tuple[str, str], str] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            # These get the sensor's name.
            if _is_added(node, "jsonl") or _is_added(node, "record"):
                continue
            named = output(node.params)
            if named is None or named[1] in STREAMS:
                continue
            key, value = named
            other = seen.setdefault(named, sensor)
            if other != sensor:
                place = f"{node.mark}  " if node.mark.line else f"{node.mark}: "
                problems.append(
                    f"{place}sinks.{node.id}.{key}: {other} and {sensor} would both write {value}; "
                    f"put {PLACEHOLDER} into it, as in out/{PLACEHOLDER}.jsonl"
                )
    return problems


def _relays(pipelines: Mapping[str, Pipeline]) -> dict[str, list[tuple[str, str]]]:
    """Address -> (sensor, sink id) of all that would publish there, where there are several."""
    shared: dict[str, list[tuple[str, str]]] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            if node.component.name == "zmq":
                endpoint = str(getattr(node.params, "endpoint", ""))
                shared.setdefault(endpoint, []).append((sensor, node.id))
    return {endpoint: ids for endpoint, ids in shared.items() if len(ids) > 1}


def _private(scratch: Path, sensor: str, id_: str) -> str:
    return f"ipc://{scratch}/{sensor}.{id_}"


@contextmanager
def _relay(endpoint: str, upstream: Sequence[str], backlog: int) -> Iterator[None]:
    """Bind `endpoint` and pass on what the upstream publishers send, while the block lasts.

    backlog : messages that may wait for each subscriber.
    """
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    front, back = context.socket(zmq.XPUB), context.socket(zmq.XSUB)
    front.linger = 500
    back.linger = 0
    # As in the sink: a slow reader shall not be seconds behind.
    front.sndhwm = back.rcvhwm = backlog
    front.setsockopt(zmq.SNDBUF, 32768)
    try:
        front.bind(endpoint)
    except zmq.ZMQError as error:
        context.destroy(linger=0)
        raise StageError(
            f"{endpoint} cannot be bound: {error.strerror}; end what publishes there, or choose another "
            "address (--set sinks.zmq.endpoint=tcp://127.0.0.1:5557)"
        ) from error
    for address in upstream:
        back.connect(address)
    stop = threading.Event()

    def pass_on() -> None:
        poller = zmq.Poller()
        poller.register(front, zmq.POLLIN)
        poller.register(back, zmq.POLLIN)
        while True:
            events = dict(poller.poll(100))
            if front in events:
                back.send(front.recv())
            if back in events:
                front.send(back.recv())
            elif stop.is_set():
                return

    thread = threading.Thread(target=pass_on, name="tactflow-relay", daemon=True)
    thread.start()
    print(f"tactflow: publishing {len(upstream)} sensors on {endpoint}", file=sys.stderr)
    try:
        yield
    finally:
        stop.set()
        thread.join(5)
        front.close()
        back.close()
        context.term()


@dataclass(slots=True)
class _Member:
    """One sensor's process and its history.

    told : signals passed on to the process. code : how the sensor ended for good.
    """

    sensor: str
    command: list[str]
    outputs: Sequence[_Output]
    process: subprocess.Popen[str] | None = None
    started: float = 0.0
    start_at: float = 0.0
    told: int = 0
    failures: int = 0
    code: int | None = None
    readers: list[threading.Thread] = field(default_factory=list[threading.Thread])


class _Supervisor:
    """Starts the processes, passes signals on, starts again what failed."""

    def __init__(self, members: Sequence[_Member]) -> None:
        self._members = members
        self._signals = 0
        self._refused = False
        self._unwritten = False
        self._output = threading.Lock()

    def run(self) -> int:
        """Until every process has ended for good; the exit code."""
        with self._counting_signals():
            while any(member.code is None for member in self._members):
                for member in self._members:
                    self._attend(member)
                time.sleep(0.05)
        for member in self._members:
            for reader in member.readers:
                reader.join(5)
        if self._signals > 1:
            return INTERRUPTED
        return next((m.code for m in self._members if m.code), StageError.exit_code if self._unwritten else 0)

    @property
    def _ends(self) -> int:
        """How often a process is to be told to end."""
        return max(self._signals, int(self._refused or self._unwritten))

    def _attend(self, member: _Member) -> None:
        if member.code is not None:
            return
        if member.process is None:
            if self._ends:
                member.code = 0
            elif time.monotonic() >= member.start_at:
                self._start(member)
            return
        code = member.process.poll()
        if code is None:
            if member.told < self._ends:
                # Not SIGINT, for which a process that is still importing shows a traceback. And one at a
                # time: two at once may arrive as one.
                member.process.send_signal(signal.SIGTERM)
                member.told += 1
            return
        member.process = None
        if code in (0, 2, INTERRUPTED) or self._ends:
            member.code = self._last_code(member, code)
            # The command line or the file is wrong for this sensor, so the whole is: end the others.
            self._refused |= code == 2
        else:
            self._start_again(member, code)

    def _last_code(self, member: _Member, code: int) -> int:
        """What counts as the exit code of a sensor that is not started again."""
        if self._ends and self._signals < 2 and code in (-signal.SIGINT, -signal.SIGTERM, INTERRUPTED):
            # The one signal came before the process could catch it.
            return 0
        if code < 0:
            self._say(member, f"was ended by signal {-code}")
            return StageError.exit_code
        return code

    def _start_again(self, member: _Member, code: int) -> None:
        """Plan the next start after a failure, if there is to be one."""
        refused = next((output.path for output in member.outputs if output.refused), None)
        if code == StageError.exit_code and refused is not None:
            self._say(member, f"failed (exit code {code}); given up, as {refused} may not be replaced")
            member.code = code
            return
        lasted = time.monotonic() - member.started
        member.failures = 1 if lasted > GOOD_RUN else member.failures + 1
        if member.failures > GIVE_UP_AFTER:
            self._say(member, f"failed {member.failures} times in a row (exit code {code}); given up")
            member.code = self._last_code(member, code)
            return
        pause = min(FIRST_PAUSE * 2 ** (member.failures - 1), LONGEST_PAUSE)
        member.start_at = time.monotonic() + pause
        self._say(member, f"failed (exit code {code}); starting again in {pause:g} s")

    def _start(self, member: _Member) -> None:
        # A session of its own: Ctrl-C on the terminal reaches the supervisor alone, which passes it on once.
        member.process = subprocess.Popen(
            _again(member.command, member.outputs),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        member.started = time.monotonic()
        assert member.process.stdout is not None
        assert member.process.stderr is not None
        for stream, target, prefix in (
            (member.process.stdout, sys.stdout, ""),
            (member.process.stderr, sys.stderr, f"[{member.sensor}] "),
        ):
            reader = threading.Thread(target=self._copy, args=(stream, target, prefix), daemon=True)
            reader.start()
            member.readers.append(reader)

    def _copy(self, stream: IO[str], target: IO[str], prefix: str) -> None:
        """Pass whole lines on, so that those of two processes do not mix."""
        with stream:
            for line in stream:
                self._print(target, prefix + line)

    def _say(self, member: _Member, text: str) -> None:
        self._print(sys.stderr, f"tactflow: {member.sensor} {text}\n")

    def _print(self, target: IO[str], text: str) -> None:
        """Write at once. When the reader has gone away, fall silent; when the disk is full, end the run."""
        with self._output:
            try:
                target.write(text)
                target.flush()
            except OSError as error:
                lead_nowhere(target)
                if target is sys.stdout and not isinstance(error, BrokenPipeError | ConnectionResetError):
                    self._unwritten = True
                    sys.stderr.write(f"tactflow: standard output: {error.strerror}; the run ends\n")

    @contextmanager
    def _counting_signals(self) -> Iterator[None]:
        def handle(_number: int, _frame: FrameType | None) -> None:
            # Nothing else: this may be in the middle of starting a process, which would not be told.
            self._signals += 1

        before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
