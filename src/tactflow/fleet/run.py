"""Runs every sensor of a pipeline file."""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, Pipeline
from tactflow.fleet.names import with_name
from tactflow.fleet.relay import relay
from tactflow.fleet.sinks import (
    Shared,
    WatchedSink,
    added,
    changes,
    clash_problems,
    shared_addresses,
)
from tactflow.fleet.supervisor import Member, Supervisor
from tactflow.system.children import python_command
from tactflow.system.signals import ending_handled


@dataclass(frozen=True, slots=True)
class Request:
    """What to run for every sensor.

    file : the pipeline file. overrides : for `--set`. added : options of the command line that added sinks,
    as in the marks of these. files : option -> path, of which each sensor gets its own. options : remaining
    command-line arguments.
    """

    file: Path
    overrides: Sequence[str]
    added: Collection[str]
    files: Mapping[str, str]
    options: Sequence[str]


def run_fleet(request: Request, pipelines: Mapping[str, Pipeline]) -> int:
    """Run every sensor's pipeline in a process of its own until all have ended.

    pipelines : sensor -> its pipeline, checked.

    Returns
    -------
    0 if all ended well, 130 after a second signal, else the exit code of the first sensor that was given up.

    Raises
    ------
    ConfigError : several sensors would write one file.
    StageError : the address for subscribers is taken.
    """
    problems = clash_problems(pipelines)
    if problems:
        raise ConfigError("\n".join(problems))
    shared = shared_addresses(pipelines)
    supervisor = Supervisor()
    with ending_handled(supervisor.count_signal), ExitStack() as stack:
        # The path of a local socket has 107 bytes at most (Linux), and TMPDIR may be longer.
        short = None if len(tempfile.gettempdir()) < 40 else "/tmp"
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactflow-", dir=short)))
        for sinks, publication in shared:
            upstream = [_private(scratch, sensor, node) for sensor, node in sinks]
            stack.enter_context(relay(publication, upstream))
        members = []
        for sensor, pipeline in pipelines.items():
            command = _command(request, sensor, pipeline, _side_by_side(sensor, pipeline, shared, scratch))
            members.append(Member(sensor, command, [WatchedSink(node) for node in pipeline.sinks]))
        return supervisor.run(members)


def _command(request: Request, sensor: str, pipeline: Pipeline, changed: Sequence[str]) -> list[str]:
    """The command that runs one sensor. changed : settings added to the user's."""
    sinks = [added(node) for node in pipeline.sinks if str(node.mark) in request.added]
    command = python_command("-m", "tactflow", "run", str(request.file), "--sensor", sensor)
    # So that it ends when the supervisor is killed.
    command.append("--end-with-stdin")
    for text in (*request.overrides, *sinks, *changed):
        command += ["--set", text]
    for option, path in request.files.items():
        command += [option, with_name(path, sensor)]
    return [*command, *request.options]


def _side_by_side(sensor: str, pipeline: Pipeline, shared: Sequence[Shared], scratch: Path) -> list[str]:
    """Settings of one sensor's sinks that depend on the other sensors."""
    relayed = {node.id for sinks, _ in shared for name, node in sinks if name == sensor}
    settings = []
    for node in pipeline.sinks:
        address = _private(scratch, sensor, node) if node.id in relayed else None
        settings += changes(node, node.component.cls.among(node.params, scratch, address))
    return settings


def _private(scratch: Path, sensor: str, node: Node) -> str:
    """Address at which a sink publishes to the relay."""
    return f"ipc://{scratch}/{sensor}.{node.id}"
