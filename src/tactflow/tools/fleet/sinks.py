"""Files and addresses declared by the sinks of several sensors: conflicts, sharing, restarts."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tactflow.config.overrides import as_yaml
from tactflow.config.sensors import PLACEHOLDER
from tactflow.engine.contract import Output, Publication, StageParams
from tactflow.engine.graph import Node, Pipeline
from tactflow.system.files import STREAMS, is_device, status


class WatchedSink:
    """The outputs of one sink, watched from before the first start of its sensor."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._before = {output: _state(output) for output in written_files(node, node.params)}

    @property
    def overrides(self) -> list[str]:
        """Settings (`--set`) with which the sink is restarted, so that what it has written is kept.

        Before it has written anything, the user's own settings apply.
        """
        return changes(self._node, self._params)

    @property
    def refused(self) -> Path | None:
        """An existing output that the sink would refuse to replace if restarted now, or None."""
        for output in written_files(self._node, self._params):
            now = _state(output)
            if output.refuses_existing and now is not None and now[0] > 0:
                return output.path
        return None

    @property
    def _params(self) -> StageParams:
        begun = any(_state(output) not in (None, before) for output, before in self._before.items())
        return self._node.component.cls.on_restart(self._node.params) if begun else self._node.params


def written_files(node: Node, params: StageParams) -> Sequence[Output]:
    """The files and folders that a sink declares, without devices and streams."""
    declared: Sequence[Output] = node.component.cls.outputs(params)
    return [
        output for output in declared if str(output.path) not in STREAMS and not is_device(str(output.path))
    ]


def changes(node: Node, params: StageParams) -> list[str]:
    """`sinks.ID.KEY=VALUE` for every parameter that differs from the sink's own."""
    old, new = _plain(node.params), _plain(params)
    return [f"sinks.{node.id}.{key}={as_yaml(value)}" for key, value in new.items() if value != old.get(key)]


def problems(pipelines: Mapping[str, Pipeline]) -> list[str]:
    """Error messages for sinks that would write or listen where another sensor's sink does.

    pipelines : sensor -> its pipeline. Results may be published at one address with the same keys.
    """
    found = [
        f"{node.mark}  sinks.{node.id}.keys: required the same for all that publish at {together.address}"
        for sinks, together in shared_addresses(pipelines)
        for _, node in sinks
        if node.component.cls.publishes(node.params).keys != together.keys
    ]
    owners: dict[str, str] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            for parameter, use, advice in _taken(node, sensor):
                owner = owners.setdefault(use, sensor)
                if owner != sensor:
                    place = f"{node.mark}  " if node.mark.line else f"{node.mark}: "
                    where = f"{place}sinks.{node.id}.{parameter}"
                    found.append(f"{where}: {owner} and {sensor} would both {use}; {advice}")
    return found


def _taken(node: Node, sensor: str) -> Iterator[tuple[str, str, str]]:
    """Resources that a sink needs exclusively: (parameter, "write FILE" or "listen at ADDRESS", advice)."""
    for output in written_files(node, node.params):
        advice = f"put {PLACEHOLDER} into it, as in out/{PLACEHOLDER}.jsonl"
        yield output.parameter, f"write {output.path}", advice
    for parameter, address in node.component.cls.binds(node.params).items():
        advice = f"give {sensor} its own, as sensors.{sensor}.sinks.{node.id}.{parameter}"
        yield parameter, f"listen at {address}", advice


class Shared(NamedTuple):
    """An address at which several sinks publish: (sensor, sink) of each, and what a relay does for all."""

    sinks: Sequence[tuple[str, Node]]
    publication: Publication


def shared_addresses(pipelines: Mapping[str, Pipeline]) -> list[Shared]:
    """Addresses shared by sinks of several sensors. pipelines : sensor -> its pipeline."""
    by_address: dict[str, list[tuple[str, Node, Publication]]] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            publication = node.component.cls.publishes(node.params)
            if publication is not None:
                by_address.setdefault(publication.address, []).append((sensor, node, publication))
    shared = []
    for address, sinks in by_address.items():
        if len(sinks) > 1:
            backlog = sum(publication.backlog for *_, publication in sinks)
            linger = max(publication.linger for *_, publication in sinks)
            together = Publication(address, backlog, sinks[0][2].keys, linger)
            shared.append(Shared([(sensor, node) for sensor, node, _ in sinks], together))
    return shared


def _plain(params: StageParams) -> dict[str, object]:
    return params.model_dump(mode="json", by_alias=True)


def _state(output: Output) -> tuple[int, ...] | None:
    """Size (of a folder: number of entries), identity and modification time; None if it does not exist."""
    file = status(str(output.path))
    is_kind = stat.S_ISDIR if output.kind == "folder" else stat.S_ISREG
    if file is None or not is_kind(file.st_mode):
        return None
    size = len(os.listdir(output.path)) if output.kind == "folder" else file.st_size
    return size, file.st_dev, file.st_ino, file.st_mtime_ns
