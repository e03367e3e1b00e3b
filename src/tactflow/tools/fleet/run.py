"""Runs every sensor of a pipeline file."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Node, Pipeline
from tactflow.system.signals import ending_handled
from tactflow.tools.fleet.relay import relay
from tactflow.tools.fleet.sinks import Shared, WatchedSink, beside_others, changes, shared_addresses
from tactflow.tools.fleet.sinks import problems as problems
from tactflow.tools.fleet.supervisor import Member, Supervisor


def run(pipelines: Mapping[str, Pipeline], arguments: Mapping[str, Sequence[str]]) -> int:
    """Run every sensor's pipeline in a process of its own until all have ended.

    pipelines : sensor -> its pipeline, checked. arguments : sensor -> command line of its process.
    Returns the exit code of `Supervisor.run`.

    Raises
    ------
    ConfigError : several sensors would write one file.
    StageError : the address for subscribers is taken.
    """
    mistakes = problems(pipelines)
    if mistakes:
        raise ConfigError("\n".join(mistakes))
    shared = shared_addresses(pipelines)
    supervisor = Supervisor()
    with ending_handled(supervisor.count_signal), ExitStack() as stack:
        # The path of a local socket has 107 bytes at most (Linux), and TMPDIR may be longer.
        short = None if len(tempfile.gettempdir()) < 40 else "/tmp"
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactflow-", dir=short)))
        for sinks, together in shared:
            upstream = [_private(scratch, sensor, node) for sensor, node, _ in sinks]
            stack.enter_context(relay(together, upstream))
        members = []
        for sensor, pipeline in pipelines.items():
            # Without -P, Python would search the current folder first for every module.
            command = [sys.executable, "-P", "-m", "tactflow", *arguments[sensor]]
            for text in _side_by_side(sensor, pipeline, shared, scratch):
                command += ["--set", text]
            members.append(Member(sensor, command, [WatchedSink(node) for node in pipeline.sinks]))
        return supervisor.run(members)


def _side_by_side(sensor: str, pipeline: Pipeline, shared: Sequence[Shared], scratch: Path) -> list[str]:
    """Settings of one sensor's sinks that depend on the other sensors."""
    relayed = {node.id for sinks, _ in shared for name, node, _ in sinks if name == sensor}
    settings = []
    for node in pipeline.sinks:
        address = _private(scratch, sensor, node) if node.id in relayed else None
        settings += changes(node, beside_others(node.params, scratch, address))
    return settings


def _private(scratch: Path, sensor: str, node: Node) -> str:
    """Address at which a sink publishes to the relay."""
    return f"ipc://{scratch}/{sensor}.{node.id}"
