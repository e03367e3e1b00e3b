"""How two pipelines differ."""

from __future__ import annotations

from typing import Any

import pytest

from tactflow.batch.compare import Comparison, Frame
from tactflow.batch.compare_page import described, text_table
from tactflow.batch.recordings import Recording

SQUARE = [[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]]
ONE = Recording("sim:one", "one")


def frame(seq: int, hull: list[list[float]] | None, width: int = 64, **values: Any) -> Frame:
    blank = {"seq": seq, "t": seq / 10, "size_width": width, "size_height": 48}
    return blank | {"contact_hull": hull} | values


def test_a_contact_of_one_only_is_counted_and_is_the_worst() -> None:
    comparison = Comparison()
    shifted = [[x + 10, y] for x, y in SQUARE]
    first = [frame(0, None), frame(1, SQUARE), frame(2, SQUARE), frame(3, SQUARE), frame(4, None)]
    second = [frame(0, None), frame(1, SQUARE), frame(2, shifted), frame(3, None), frame(5, None)]
    comparison.add(ONE, first, second)
    assert (comparison.frames, comparison.alone) == (4, 2)
    assert (comparison.both, comparison.only_first, comparison.only_second) == (2, 1, 0)
    assert comparison.overlap == pytest.approx((1 + 1 / 3) / 2)
    assert [(worst.seq, round(worst.overlap, 3)) for worst in comparison.worst] == [(3, 0.0), (2, 0.333)]
    assert "contact in 2 of both, in 1 of A only, in 0 of B only" in described(comparison, ("A", "B"))[0]


def test_directions_are_compared_across_the_half_turn() -> None:
    comparison = Comparison()
    comparison.add(ONE, [frame(0, SQUARE, contact_angle=89.0)], [frame(0, SQUARE, contact_angle=-88.0)])
    assert comparison.spreads["contact_angle"].mean == pytest.approx(3.0)


def test_smaller_pictures_are_measured_in_the_pixels_of_the_first() -> None:
    half = [[(x + 0.5) / 2 - 0.5, (y + 0.5) / 2 - 0.5] for x, y in SQUARE]
    comparison = Comparison()
    first = frame(0, SQUARE, contact_area=400.0, contact_center_x=20.0, flow_mean_x=3.0, flow_rotation=4.0)
    second = frame(0, half, 32, contact_area=100.0, contact_center_x=9.75, flow_mean_x=1.5, flow_rotation=5.0)
    comparison.add(ONE, [first], [second])
    means = {name: spread.mean for name, spread in comparison.spreads.items()}
    assert means == {"contact_area": 0.0, "contact_center_x": 0.0, "flow_mean_x": 0.0, "flow_rotation": 1.0}
    assert comparison.overlap == pytest.approx(1.0)
    (line,) = text_table(comparison)[1:]
    assert line.startswith("flow_rotation")
