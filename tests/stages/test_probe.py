"""The probe stage: reference frames, the safety net, what it watches."""

from __future__ import annotations

import numpy as np
import pytest

from tactflow.engine.frame import Frame
from tactflow.stages.probe import Probe


def suspects(probe: Probe, count: int, *, reference: bool = False, skip: int = 0) -> list[bool]:
    """What it says of frames of a still scene with noise."""
    random = np.random.default_rng(skip)
    return [
        probe.process(
            Frame("s", i, i / 60, random.integers(95, 105, (60, 80, 3), np.uint8), reference=reference)
        ).suspect
        for i in range(count)
    ]


def test_a_still_scene_is_worked_on_at_least_every_so_many_frames() -> None:
    found = suspects(Probe(Probe.Params(at_least_every=5)), 40)
    assert all(any(found[first : first + 5]) for first in range(36))
    assert sum(found[10:]) <= 8


def test_while_something_touches_every_frame_is_worked_on() -> None:
    probe = Probe(Probe.Params())
    assert not all(suspects(probe, 20))
    probe.watched = True
    assert all(suspects(probe, 20, skip=1))


def test_without_skipping_nothing_is_looked_at() -> None:
    assert all(suspects(Probe(Probe.Params(), skipping=False), 20))


def test_a_reference_frame_is_always_worked_on() -> None:
    assert all(suspects(Probe(Probe.Params()), 20, reference=True))


def test_a_reset_starts_anew() -> None:
    probe = Probe(Probe.Params())
    assert not suspects(probe, 20)[-1]
    probe.reset()
    assert suspects(probe, 1, skip=1) == [True]


@pytest.mark.parametrize(("repeatability", "suspect"), [(0.025, False), (0.005, True)])
def test_it_is_as_sensitive_as_the_contact_test_is_set_to_be(repeatability: float, suspect: bool) -> None:
    probe = Probe(Probe.Params(repeatability=repeatability, tint=0.005))
    assert not suspects(probe, 20)[-1]
    brighter = np.full((60, 80, 3), 100, np.uint8)
    brighter[20:40, 30:50] += 5
    assert probe.process(Frame("s", 20, 0.4, brighter)).suspect is suspect
