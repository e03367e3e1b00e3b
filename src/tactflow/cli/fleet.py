"""Several sensors: one process for each, under one supervisor.

Each process runs the pipeline for its sensor. What they publish over ZeroMQ comes out at the one address
that the pipeline names: the supervisor binds it and passes messages on, and subscriptions back, so that a
process still knows whether anybody listens. A process that fails is started again with a growing pause;
the others go on.
"""

from __future__ import annotations

import argparse
import json
import signal
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
from typing import IO

import zmq

from tactflow.engine.errors import ConfigError, StageError
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.priority import ZMQ_SENDS, Precedence, threads_named
from tactflow.engine.run import INTERRUPTED
from tactflow.engine.sensors import PLACEHOLDER

FIRST_PAUSE = 1.0
LONGEST_PAUSE = 30.0
GIVE_UP_AFTER = 5
"""Failures in a row after which a sensor is not started again."""
GOOD_RUN = 30.0
"""A process that ran so long, s, starts with the first pause again when it fails."""


def run_fleet(args: argparse.Namespace, file: Path, pipelines: Mapping[str, Pipeline]) -> int:
    """Run every sensor's pipeline in a process of its own until all have ended.

    args : as `tactflow run` got them. file : the pipeline file. pipelines : sensor -> its pipeline, checked.

    Returns
    -------
    0 if all ended well, 130 after a second signal, else the exit code of the first sensor that was given up.

    Raises
    ------
    ConfigError : several sensors would write one file or read one source. StageError : the address for
        subscribers is taken.
    """
    _refuse_clashes(args, pipelines)
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactflow-")))
        relays = _relays(pipelines)
        for endpoint, ids in relays.items():
            upstream = [_private(scratch, name, id_) for name, id_ in ids]
            backlog = sum(getattr(pipelines[name].nodes[id_].params, "backlog", 1) for name, id_ in ids)
            realtime = all(pipeline.realtime_priority for pipeline in pipelines.values())
            stack.enter_context(_relay(endpoint, upstream, backlog, realtime))
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
            private += _added_sinks(pipelines[name], name)
            command = _command(args, file, name, private)
            members.append(_Member(name, command, _again(command, pipelines[name])))
        return _Supervisor(members).run()


def with_name(path: str, sensor: str) -> str:
    """The file that one sensor's process writes where the command line names `path` for all of them."""
    if path == "-":
        return path
    if PLACEHOLDER in path:
        return path.replace(PLACEHOLDER, sensor)
    whole = Path(path)
    return str(whole.with_name(f"{whole.stem}-{sensor}{whole.suffix}"))


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


def _lines(pipeline: Pipeline) -> Iterator[tuple[Node, str]]:
    """The sinks that write JSON Lines, and where to."""
    for node in pipeline.sinks:
        if node.component.name == "jsonl":
            yield node, str(getattr(node.params, "path", "-"))


def _added_sinks(pipeline: Pipeline, sensor: str) -> list[str]:
    """The sinks of `--jsonl` as overrides, so that a later override may change them."""
    return [
        f"sinks.{node.id}={{use: jsonl, path: {json.dumps(with_name(path, sensor))}}}"
        for node, path in _lines(pipeline)
        if str(node.mark).startswith("--jsonl")
    ]


def _again(command: Sequence[str], pipeline: Pipeline) -> list[str]:
    """The command that starts a sensor after a failure: what it has written so far must stay."""
    kept = [word for word in command if word not in ("--overwrite", "--number")]
    if "record" in command[:4]:
        kept.append("--number")
    for node, path in _lines(pipeline):
        if path != "-":
            kept += ["--set", f"sinks.{node.id}.overwrite=false", "--set", f"sinks.{node.id}.append=true"]
    return kept


def _refuse_clashes(args: argparse.Namespace, pipelines: Mapping[str, Pipeline]) -> None:
    problems = []
    if args.source is not None:
        problems.append(
            f"--source: the pipeline has {len(pipelines)} sensors, each with its own source; choose one with "
            f"--sensor {next(iter(pipelines))}, or use --set sensors.NAME.stages.capture.source=..."
        )
    seen: dict[tuple[str, object], str] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            for key in ("path", "folder"):
                value = getattr(node.params, key, None)
                if value is None or value == "-":
                    continue
                other = seen.setdefault((key, value), sensor)
                if other != sensor and not str(node.mark).startswith("--"):
                    problems.append(
                        f"{node.mark}  sinks.{node.id}.{key}: {other} and {sensor} would both write {value}; "
                        f"put {PLACEHOLDER} into it, as in out/{PLACEHOLDER}.jsonl"
                    )
    if problems:
        raise ConfigError("\n".join(problems))


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
def _relay(endpoint: str, upstream: Sequence[str], backlog: int, realtime: bool) -> Iterator[None]:
    """Bind `endpoint` and pass on what the upstream publishers send, while the block lasts.

    backlog : messages that may wait for each subscriber. realtime : whether to ask for real-time priority.
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
    sending = [thread.native_id or 0, *threads_named(ZMQ_SENDS)]
    precedence = Precedence(lambda: sending, realtime, len(upstream), "messages of all sensors")
    precedence.start()
    print(f"tactflow: publishing {len(upstream)} sensors on {endpoint}", file=sys.stderr)
    try:
        yield
    finally:
        precedence.stop()
        stop.set()
        thread.join(5)
        front.close()
        back.close()
        context.term()


@dataclass(slots=True)
class _Member:
    """One sensor's process and its history."""

    sensor: str
    command: list[str]
    again: list[str]
    process: subprocess.Popen[str] | None = None
    started: float = 0.0
    start_at: float = 0.0
    failures: int = 0
    code: int | None = None
    readers: list[threading.Thread] = field(default_factory=list[threading.Thread])


class _Supervisor:
    """Starts the processes, passes signals on, starts again what failed."""

    def __init__(self, members: Sequence[_Member]) -> None:
        self._members = members
        self._signals = 0
        self._output = threading.Lock()

    def run(self) -> int:
        """Until every process has ended for good; the exit code."""
        with self._passing_signals_on():
            while any(member.code is None for member in self._members):
                for member in self._members:
                    self._attend(member)
                time.sleep(0.05)
        for member in self._members:
            for reader in member.readers:
                reader.join(5)
        if self._signals > 1:
            return INTERRUPTED
        return next((m.code for m in self._members if m.code), 0)

    def _attend(self, member: _Member) -> None:
        if member.code is not None:
            return
        if member.process is None:
            if self._signals:
                member.code = 0
            elif time.monotonic() >= member.start_at:
                self._start(member)
            return
        code = member.process.poll()
        if code is None:
            return
        member.process = None
        if code in (0, 2, INTERRUPTED) or self._signals:
            member.code = code
            if code == 2:
                # The command line or the file is wrong for this sensor, so the whole is: end the others.
                self._send(signal.SIGTERM)
            return
        lasted = time.monotonic() - member.started
        member.failures = 1 if lasted > GOOD_RUN else member.failures + 1
        if member.failures > GIVE_UP_AFTER:
            self._say(member, f"failed {member.failures} times in a row (exit code {code}); given up")
            member.code = code
            return
        pause = min(FIRST_PAUSE * 2 ** (member.failures - 1), LONGEST_PAUSE)
        member.start_at = time.monotonic() + pause
        member.command = member.again
        self._say(member, f"failed (exit code {code}); starting again in {pause:g} s")

    def _start(self, member: _Member) -> None:
        # A session of its own: Ctrl-C on the terminal reaches the supervisor alone, which passes it on once.
        member.process = subprocess.Popen(
            member.command,
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
                with self._output:
                    target.write(prefix + line)
                    target.flush()

    def _say(self, member: _Member, text: str) -> None:
        with self._output:
            print(f"tactflow: {member.sensor} {text}", file=sys.stderr)

    def _send(self, number: int) -> None:
        for member in self._members:
            if member.process is not None:
                member.process.send_signal(number)

    @contextmanager
    def _passing_signals_on(self) -> Iterator[None]:
        def handle(number: int, _: FrameType | None) -> None:
            self._signals += 1
            self._send(number)

        before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
