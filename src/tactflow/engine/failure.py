"""The error message of a stage or sink that failed."""

from __future__ import annotations

import os
import traceback
from collections.abc import Sequence
from typing import Any

from tactflow.engine.conformance import METHODS
from tactflow.engine.errors import StageError, TactflowError
from tactflow.engine.frame import Frame
from tactflow.engine.graph import Node


def describe_failure(node: Node, frame: Frame, values: Sequence[Any], error: Exception) -> StageError:
    """Describe which node failed in which frame, where in its code, and with which inputs.

    values : of its inputs, in the order of its ports.
    """
    if isinstance(error, TactflowError):
        return StageError(f"{node.id}, frame {frame.seq} ({node.mark}): {error}")
    engine = os.path.dirname(__file__)
    entries = traceback.extract_tb(error.__traceback__)
    # The calls of the engine come first, then the code of the node.
    own = next((entry for entry in entries if os.path.dirname(entry.filename) != engine), None)
    if own is None:
        # The engine rejected the returned value.
        code = getattr(node.component.cls, METHODS[node.component.kind]).__code__
        where = f"{code.co_filename}:{code.co_firstlineno}"
    else:
        where = f"{own.filename}:{own.lineno}"
        if entries[-1] is not own:
            where += f" (raised at {entries[-1].filename}:{entries[-1].lineno})"
    ports = node.component.ports.inputs
    inputs = [f"{port.name}: {_describe(value)}" for port, value in zip(ports, values, strict=True)]
    return StageError(
        f"{node.id} failed at frame {frame.seq}: {type(error).__name__}: {error}\n"
        f"  in {where}\n  set up at {node.mark}\n  inputs: {', '.join(inputs) or 'none'}"
    )


def _describe(value: Any) -> str:
    """Shape and dtype of an array, else the type's name."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{tuple(value.shape)} {value.dtype}"
    return "absent" if value is None else type(value).__name__
