"""What is said about a stage or sink that failed."""

from __future__ import annotations

import inspect
import os
import traceback
from collections.abc import Sequence
from typing import Any

from tactflow.engine.check import wrong_input
from tactflow.engine.conformance import METHODS
from tactflow.engine.errors import StageError, TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Node


def describe_failure(
    node: Node, frame: Frame, values: Sequence[Any], error: Exception | SystemExit
) -> StageError:
    """An error that says which node failed on which frame, where in its code, and with what inputs; and who
    gave an input that its port does not allow.

    values : of its inputs, in the order of its ports.
    """
    if isinstance(error, TactflowError):
        return StageError(f"{node.id}, frame {frame.seq} ({node.mark}): {error}")
    place = traceback.extract_tb(error.__traceback__)
    # The first entries are the engine's own calls; after them comes the node's own code.
    code = next((entry for entry in place if not _of_the_engine(entry.filename)), None)
    where = _own_method(node) if code is None else f"{code.filename}:{code.lineno}"
    if code is not None and place[-1] is not code:
        where += f" (raised at {place[-1].filename}:{place[-1].lineno})"
    ports = node.component.ports.inputs
    inputs = ", ".join(
        f"{port.name}: {describe_value(value)}" for port, value in zip(ports, values, strict=True)
    )
    culprit = wrong_input(node, values)
    return StageError(
        f"{node.id} failed at frame {frame.seq}: {type(error).__name__}: {error}\n"
        f"  in {where}\n  set up at {node.mark}\n  inputs: {inputs or 'none'}"
        + (f"\n  {culprit}" if culprit else "")
    )


def describe_value(value: Any) -> str:
    """Shape and dtype of an array, else the type's name."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {value.dtype}"
    return "absent" if value is None else type(value).__name__


def _own_method(node: Node) -> str:
    """Where the method of a node begins: the place to name when the engine refuses what it returned."""
    function = inspect.unwrap(getattr(node.component.cls, METHODS[node.component.kind]))
    return f"{function.__code__.co_filename}:{function.__code__.co_firstlineno}"


def _of_the_engine(file: str) -> bool:
    return os.path.dirname(file) == os.path.dirname(__file__)
