"""Files and addresses declared by the sinks of several sensors: conflicts, sharing, restarts."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from tactflow.config.overrides import as_yaml
from tactflow.config.sensors import PLACEHOLDER
from tactflow.engine.contract import StageParams
from tactflow.engine.graph import Node, Pipeline
from tactflow.network.address import Address
from tactflow.network.parameters import PublisherParams
from tactflow.system.files import STREAMS, is_device, next_name, status


class WatchedSink:
    """The outputs of one sink, watched from before the first start of its sensor."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._before = {path: _state(path) for path in written_files(node, node.params).values()}

    @property
    def overrides(self) -> list[str]:
        """Settings (`--set`) with which the sink is restarted, so that what it has written is kept.

        Before it has written anything, the user's own settings apply.
        """
        return changes(self._node, self._params)

    @property
    def refused(self) -> Path | None:
        """An existing output that the sink would refuse to replace if restarted now, or None."""
        params = self._params
        if not getattr(params, "refuses_existing", False):
            return None
        states = {path: _state(path) for path in written_files(self._node, params).values()}
        return next((path for path, state in states.items() if state is not None and state[0] > 0), None)

    @property
    def _params(self) -> StageParams:
        begun = any(_state(path) not in (None, before) for path, before in self._before.items())
        return _continued(self._node) if begun else self._node.params


def _continued(node: Node) -> StageParams:
    """The parameters with which a sink keeps what it has written: it appends, or else writes beside it."""
    params = node.params
    settings: dict[str, object] = {}
    if "append" in type(params).model_fields:
        settings["append"] = True
    else:
        settings = {name: str(next_name(path)) for name, path in written_files(node, params).items()}
    if "overwrite" in type(params).model_fields:
        settings["overwrite"] = False
    return params.changed(**settings)


def beside_others(params: StageParams, folder: Path, address: str | None) -> StageParams:
    """The parameters of a sink in a run of several sensors.

    params : its own. folder : shared by the sensors of the run, removed at its end. address : at which it
    publishes for the relay; None for a sink that has an address of its own, or none.
    """
    if "neighbours" in type(params).model_fields:
        return params.changed(neighbours=str(folder))
    if isinstance(params, PublisherParams) and address is not None:
        # The relay requires the keys of subscribers.
        kept = params.commanders if params.control is not None else params.control_keys
        return params.changed(endpoint=address, keys=None, control_keys=kept)
    return params


def written_files(node: Node, params: StageParams) -> dict[str, Path]:
    """The files and folders that a sink declares, by parameter; without devices and streams."""
    declared: Mapping[str, Path] = node.component.cls.outputs(params)
    return {
        name: path for name, path in declared.items() if str(path) not in STREAMS and not is_device(str(path))
    }


def changes(node: Node, params: StageParams) -> list[str]:
    """`sinks.ID.KEY=VALUE` for every parameter that differs from the sink's own."""
    old, new = _plain(node.params), _plain(params)
    return [f"sinks.{node.id}.{key}={as_yaml(value)}" for key, value in new.items() if value != old.get(key)]


def problems(pipelines: Mapping[str, Pipeline]) -> list[str]:
    """Error messages for sinks that would write or listen where another sensor's sink does.

    pipelines : sensor -> its pipeline. Results may be published at one address with the same keys.
    """
    found = [
        f"{node.mark}  sinks.{node.id}.keys: required the same for all that publish at {together.endpoint}"
        for sinks, together in shared_addresses(pipelines)
        for _, node, params in sinks
        if params.keys != together.keys
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
    for parameter, path in written_files(node, node.params).items():
        advice = f"put {PLACEHOLDER} into it, as in out/{PLACEHOLDER}.jsonl"
        yield parameter, f"write {path}", advice
    control = node.params.control if isinstance(node.params, PublisherParams) else None
    if control is not None and not Address.parse(control).picks_a_port:
        advice = f"give {sensor} its own, as sensors.{sensor}.sinks.{node.id}.control"
        yield "control", f"listen at {control}", advice


class Shared(NamedTuple):
    """An address at which several sinks publish.

    Attributes
    ----------
    sinks : (sensor, sink, its parameters) of each.
    together : parameters of a sink that publishes for all.
    """

    sinks: Sequence[tuple[str, Node, PublisherParams]]
    together: PublisherParams


def shared_addresses(pipelines: Mapping[str, Pipeline]) -> list[Shared]:
    """Addresses shared by sinks of several sensors. pipelines : sensor -> its pipeline."""
    by_address: dict[str, list[tuple[str, Node, PublisherParams]]] = {}
    for sensor, pipeline in pipelines.items():
        for node in pipeline.sinks:
            if isinstance(node.params, PublisherParams):
                by_address.setdefault(node.params.endpoint, []).append((sensor, node, node.params))
    shared = []
    for sinks in by_address.values():
        if len(sinks) > 1:
            backlog = sum(params.backlog for *_, params in sinks)
            linger = max(params.linger for *_, params in sinks)
            together = sinks[0][2].changed(backlog=backlog, linger=linger)
            shared.append(Shared(sinks, together))
    return shared


def _plain(params: StageParams) -> dict[str, object]:
    return params.model_dump(mode="json", by_alias=True)


def _state(path: Path) -> tuple[int, ...] | None:
    """Size (of a folder: number of entries), identity and modification time; None if it does not exist."""
    file = status(str(path))
    if file is None:
        return None
    size = len(os.listdir(path)) if stat.S_ISDIR(file.st_mode) else file.st_size
    return size, file.st_dev, file.st_ino, file.st_mtime_ns
