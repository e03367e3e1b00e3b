"""The original script as stages: each is its function, and the pipeline names them."""

from __future__ import annotations

import numpy as np

from tactflow.classic import functions
from tactflow.classic.stages import ConvexHull, Difference, FlowMask, MaskMarker, Tracker
from tactflow.engine.frame import Absent, Frame
from tactflow.vision.types import Contact
from tests.vision.dots import grid, render

GREY = np.full((40, 60, 3), 100, np.uint8)


def frame(seq: int, *, reference: bool = False) -> Frame:
    return Frame("test", seq, seq / 60, GREY, reference=reference)


def touched() -> np.ndarray:
    image = GREY.copy()
    image[10:30, 10:40] += 20
    return image


def test_the_difference_is_taken_from_the_last_reference_until_a_reset() -> None:
    stage = Difference(Difference.Params())
    assert not stage.process(GREY - np.uint8(50), frame(0, reference=True)).touching
    assert not stage.process(GREY, frame(1, reference=True)).touching
    result = stage.process(touched(), frame(2))
    assert result.touching
    assert np.array_equal(result.contact_mask, functions.difference(touched(), GREY))
    stage.reset()
    assert not stage.process(touched(), frame(3)).touching


def test_the_other_stages_are_their_functions() -> None:
    centers = grid(6, 6, 30.0, corner=(25.0, 28.0), jitter=0.4)
    image, moved = render((205, 210), centers, 4.2), render((205, 210), centers + 3.0, 4.2)
    mask = MaskMarker(MaskMarker.Params()).process(image)
    assert np.array_equal(mask, functions.mask_marker(image))
    tracker = Tracker(Tracker.Params())
    tracker.process(image)
    markers = tracker.process(moved)
    flow = FlowMask(FlowMask.Params()).process(markers, mask)
    assert flow == functions.mean_flow(markers, mask, dilate=8)
    tracker.reset()
    assert np.abs(tracker.process(moved).displacement).max() == 0
    hull = ConvexHull(ConvexHull.Params())
    contact = hull.process(mask)
    expected = functions.get_convex_hull_area(mask)
    assert isinstance(contact, Contact)
    assert expected is not None
    assert np.array_equal(contact.hull, expected.hull)
    assert hull.process(0 * mask) == Absent("no_contact")
