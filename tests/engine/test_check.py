"""What is said of records that are not what their type promises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.check import wrong_input
from tactflow.engine.conformance import component
from tactflow.engine.contract import Sink, StageParams
from tactflow.engine.graph import Mark, Node, Ref

if TYPE_CHECKING:
    from decimal import Decimal


@dataclass(frozen=True)
class Track:
    """place : (N, 2) float64. age : (N,) uint8."""

    place: NDArray[np.float64]
    age: NDArray[np.uint8]
    name: str = ""


@dataclass(frozen=True)
class Hidden:
    """cost : of a type that only type checkers see."""

    cost: Decimal


@dataclass(frozen=True)
class Loose:
    """Arrays of no certain dtype."""

    anything: NDArray[Any]
    numbers: NDArray[np.floating]
    words: NDArray[np.str_]
    least: np.ndarray[Any, Any]


class Tracks(Sink):
    def write(self, track: Track) -> None: ...


class Looses(Sink):
    def write(self, loose: Loose) -> None: ...


class Costs(Sink):
    def write(self, hidden: Hidden) -> None: ...


def said_of(value: Any, sink: type[Sink]) -> str | None:
    """What is said where the node `mine` gave this value."""
    found = component(sink, "sink", "test", ())
    inputs = {port.name: Ref("mine", port.name) for port in found.ports.inputs}
    return wrong_input(Node("sink", found, StageParams(), inputs, Mark("test", 0, 0)), [value])


@pytest.mark.parametrize(
    ("place", "age", "wrong"),
    [
        (np.float32, np.uint8, "place: required an array of float64, got float32"),
        (np.float64, np.bool_, "age: required an array of uint8, got bool"),
        (np.float64, list, "age: required an array of uint8, got list"),
    ],
)
def test_an_array_of_another_type_in_a_record_is_named(
    place: type[np.generic], age: Callable[[Any], Any], wrong: str
) -> None:
    numbers = np.zeros(3)
    ages = age(numbers) if age is list else numbers.astype(age)
    said = said_of(Track(np.zeros((3, 2), place), ages), Tracks)
    assert said == f"mine gave a wrong value: port track, {wrong}"


def test_a_record_that_is_right_or_cannot_be_read_is_not_blamed() -> None:
    assert said_of(Track(np.zeros((3, 2)), np.zeros(3, np.uint8)), Tracks) is None
    assert said_of(Hidden(None), Costs) is None  # type: ignore[arg-type]
    numbers = np.zeros(3, np.float32)
    assert said_of(Loose(numbers, numbers, np.array(["left"]), numbers), Looses) is None
