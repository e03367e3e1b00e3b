"""Opening and closing the source, the stages and the sinks of a run."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

from tactflow.engine.conformance import build
from tactflow.engine.contract import Part, Source, Stage
from tactflow.engine.control import Control
from tactflow.engine.errors import SourceError, StageError, TactflowError
from tactflow.engine.graph import Node, Pipeline
from tactflow.engine.node import UNCONNECTED, RunningNode, Slots
from tactflow.engine.once import Once


class Parts:
    """The open parts of a run.

    Parameters
    ----------
    control : handed to parts that ask for it.
    offered : further arguments of constructors, by name.
    check : as in `Runner`.

    Attributes
    ----------
    source : once it is open.
    nodes : id -> open stage or sink.
    slots : of the outputs of all nodes.
    """

    def __init__(
        self, pipeline: Pipeline, control: Control, offered: Mapping[str, Any], *, check: bool
    ) -> None:
        self._pipeline = pipeline
        self._check = check
        self._once = Once()
        self._offered = {
            **offered,
            "sensor": pipeline.sensor,
            "directory": pipeline.directory,
            "skipping": pipeline.skipping,
            "control": control,
        }
        self._opened: list[tuple[str, Part]] = []
        self.source: Source | None = None
        self.nodes: dict[str, RunningNode] = {}
        ports = [(id_, port.name) for id_, n in pipeline.nodes.items() for port in n.component.ports.outputs]
        self.slots: Slots = {port: slot for slot, port in enumerate(ports, start=UNCONNECTED + 1)}

    def open_source(self) -> Source:
        """Open the source: before the stages and sinks, so that a missing recording truncates no file."""
        source = self._open(self._pipeline.source, SourceError)
        assert isinstance(source, Source)
        self.source = source
        return source

    def open_nodes(self, pruned: Collection[Node], stopping: threading.Event) -> None:
        """Open the stages, then the sinks, and begin the output.

        pruned : left out. stopping : if set, open no more, so that a run without frames empties no file.
        """
        left_out = {node.id for node in pruned}
        for node in self._pipeline.nodes.values():
            if stopping.is_set():
                return
            if node.component.kind != "source" and node.id not in left_out:
                part = self._open(node, StageError)
                self.nodes[node.id] = RunningNode(
                    node, part, self.slots, skipping=self._pipeline.skipping, check=self._check
                )
        for running in self.nodes.values():
            if running.sink is not None:
                with _located(running.node, StageError):
                    running.sink.begin()

    def _open(self, node: Node, kind: type[TactflowError]) -> Part:
        """Construct and open the part of a node."""
        with _located(node, kind):
            part = build(node.component.make, node.params, self._offered)
            self._opened.append((node.id, part))
            if isinstance(part, Stage):
                part.once = self._once
            part.open()
        return part

    def close(self, in_use: Collection[str | None], fail: Callable[[TactflowError, Exception], None]) -> None:
        """Close all opened parts in reverse order, even if some fail.

        in_use : ids of parts that a thread still uses, which are not closed: closing a video while it is
        read, or a file while it is written, may block forever. fail : called with each error and its cause.
        """
        opened, self._opened = self._opened, []

        def close(node_id: str, part: Part) -> None:
            try:
                part.close()
            except Exception as error:
                fail(StageError(f"{node_id}: closing failed: {error}"), error)

        # An interrupt during one of them is raised after closing the others.
        with ExitStack() as stack:
            for node_id, part in opened:
                if node_id not in in_use:
                    stack.callback(close, node_id, part)


@contextmanager
def _located(node: Node, kind: type[TactflowError]) -> Iterator[None]:
    """Add the node and its line to errors of opening it."""
    try:
        yield
    except kind as error:
        raise kind(f"{node.id} ({node.mark}): {error}") from error
    except TactflowError:
        raise
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise kind(
            f"{node.id} ({node.mark}): cannot be opened: {type(error).__name__}: {error}\n"
            f"  in {place.filename}:{place.lineno}"
        ) from error
