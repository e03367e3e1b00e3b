"""Hold: a signal stays true for some frames more, and becomes true now and then anyway."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from tactflow.stages.hold import Hold

PULSES = [i % 10 in (3, 4, 5, 6) for i in range(20)]


def frames(hold: Hold, signal: Sequence[bool] = PULSES) -> list[int]:
    """The frames in which the held signal is true."""
    return [i for i, value in enumerate(signal) if hold.process(value)]


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        (Hold.Params(), [3, 4, 5, 6, 13, 14, 15, 16]),
        (Hold.Params(hold=2), [3, 4, 5, 6, 7, 8, 13, 14, 15, 16, 17, 18]),
        (Hold.Params(at_least_every=4), [3, 4, 5, 6, 10, 13, 14, 15, 16]),
        (Hold.Params(hold=1, at_least_every=5), [3, 4, 5, 6, 7, 12, 13, 14, 15, 16, 17]),
        (Hold.Params(at_least_every=1), list(range(20))),
    ],
    ids=["neither", "hold", "at least every", "both", "always"],
)
def test_a_signal_is_held_and_comes_at_least_every_so_many_frames(
    params: Hold.Params, expected: list[int]
) -> None:
    assert frames(Hold(params)) == expected


def test_a_signal_that_rises_again_is_held_anew() -> None:
    assert frames(Hold(Hold.Params(hold=2)), [True, False, True, False, False, False]) == [0, 1, 2, 3, 4]


def test_a_new_reference_forgets_what_was_held_and_what_was_due() -> None:
    hold = Hold(Hold.Params(hold=3, at_least_every=2))
    assert frames(hold, [True, False]) == [0, 1]
    hold.reset()
    assert frames(hold, [False, False, False, False]) == [1, 3]
