"""Selection of the spots that are marks, among candidates of several scales."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.vision.markers.lattice import Lattice
from tactflow.vision.markers.selection import Candidate, at_own_scale
from tactflow.vision.markers.spots import Spots
from tests.vision.dots import grid

INNER = grid(3, 4, 30.0, corner=(80, 60))
ALL = grid(5, 6, 30.0, corner=(50, 30))


def candidate(points: NDArray[np.float64], radius: float, strength: float, score: float = 5.0) -> Candidate:
    one = np.ones(len(points))
    spots = Spots(points, radius * one, strength * one, one, one)
    return Candidate(spots, radius, "dark", score, Lattice(points))


WIDE = candidate(INNER, 8.0, 12.0)


def test_marks_are_taken_at_the_finer_scale_that_has_them_all() -> None:
    middle, fine = candidate(ALL[:-6], 5.0, 15.0), candidate(ALL, 3.0, 18.0, 4.0)
    assert at_own_scale(WIDE, [WIDE, fine, middle]) is fine
    assert at_own_scale(WIDE, [WIDE, middle]) is middle
    assert at_own_scale(fine, [WIDE, fine, middle]) is fine


def test_a_scrap_that_a_finer_scale_lacks_does_not_count() -> None:
    fine = candidate(ALL, 3.0, 18.0)
    scraps = np.array([[10.0, 5.0], [230.0, 5.0]])
    for count, expected in ((1, True), (2, False)):
        wide = candidate(np.concatenate([INNER, scraps[:count]]), 8.0, 12.0)
        assert (at_own_scale(wide, [wide, fine]) is fine) == expected


@pytest.mark.parametrize(
    "other",
    [
        candidate(ALL, 10.0, 18.0),
        candidate(ALL, 3.0, 1.0),
        candidate(INNER, 3.0, 18.0),
        candidate(np.concatenate([INNER - 3, INNER + 3]), 3.0, 18.0),
        candidate(ALL, 3.0, 18.0)._replace(polarity="bright"),
    ],
    ids=["wider", "fainter", "no further marks", "halves of the marks", "of the other polarity"],
)
def test_other_scales_do_not_take_the_place_of_a_candidate(other: Candidate) -> None:
    assert at_own_scale(WIDE, [WIDE, other]) is WIDE
