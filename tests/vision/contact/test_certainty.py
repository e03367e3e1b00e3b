"""How probable it is that a region is a contact."""

from __future__ import annotations

import numpy as np
import pytest

import tactflow
from tactflow.vision.contact.certainty import contact_evidence, with_probability, without_doubtful
from tactflow.vision.geometry.hull import contact_parts

MASK = np.zeros((80, 120), np.uint8)
MASK[8:40, 8:48] = MASK[48:64, 80:96] = 255
PARTS = contact_parts(MASK)


def changed(light: float, colour: float) -> np.ndarray:
    """Squared deviations: of the first region as given, of the second one 100 and 100."""
    deviations = np.zeros((2, 20, 30), np.float32)
    deviations[:, 2:10, 2:12] = np.array([light, colour])[:, None, None]
    deviations[:, 12:16, 20:24] = 100
    return deviations


def test_evidence_is_of_the_regions_own_cells() -> None:
    evidence = contact_evidence(PARTS, MASK, changed(50.0, 25.0))
    assert evidence == pytest.approx(np.array([[np.log(0.5), 0], [0, 0]]))
    # Nothing is known of its colour: a finite number all the same.
    assert np.isfinite(contact_evidence(PARTS, MASK, changed(50.0, 0.0))).all()


def test_what_changes_colour_and_moves_markers_is_more_probable() -> None:
    plain = with_probability(PARTS, MASK, changed(50.0, 50.0))
    grey = with_probability(PARTS, MASK, changed(50.0, 1.0))
    both = with_probability(contact_parts(MASK, evidence="both"), MASK, changed(50.0, 50.0))
    probabilities = [[part.probability or 0.0 for part in parts] for parts in (grey, plain, both)]
    assert probabilities[0][0] < 0.1 < 0.5 < probabilities[1][0] < probabilities[2][0] < 1
    dots = with_probability(contact_parts(MASK, evidence="dots"), MASK, changed(50.0, 50.0))
    assert {part.probability for part in dots} == {None}


def test_a_simulated_contact_says_how_probable_it_is_and_so_does_its_message() -> None:
    settings = {"sinks.zmq": None, "sinks.view": None}
    results = list(tactflow.stream("default", source="sim:two?frames=50", settings=settings))
    touched = [result for result in results if len(result.contacts) == 2]
    assert touched
    for result in touched:
        assert result.contact is not None
        assert result.contact.probability == result.contacts[0].probability
        assert all(part.probability is not None and part.probability > 0.5 for part in result.contacts)
        message = result.to_dict()
        assert [part["probability"] for part in message["contacts"]] == [
            part.probability for part in result.contacts
        ]


def test_a_contact_under_white_lamps_is_probable_without_a_change_of_colour() -> None:
    settings = {"sinks.zmq": None, "sinks.view": None}
    results = tactflow.stream("default", source="sim:press?light=bright&frames=24", settings=settings)
    probabilities = [result.contact.probability or 0.0 for result in results if result.contact is not None]
    # The first touch is too faint to tell that all channels change alike.
    assert len(probabilities) > 2
    assert min(probabilities[1:]) > 0.5


def test_what_is_improbable_beside_another_does_not_count_and_is_reported() -> None:
    small = MASK.copy()
    small[48:64, 80:96] = 0
    grey = changed(50.0, 50.0)
    grey[1, 12:16, 20:24] = 1
    probable, kept = without_doubtful(with_probability(PARTS, MASK, grey), MASK)
    assert np.array_equal(kept, small)
    assert [part.region_area for part in probable] == [PARTS[0].region_area]
    sure = with_probability(contact_parts(MASK, evidence="both"), MASK, changed(50.0, 50.0))
    assert without_doubtful(sure, MASK)[1] is MASK
    # One alone is kept, however improbable.
    alone = with_probability(contact_parts(small), small, changed(50.0, 0.01))
    assert without_doubtful(alone, small)[1] is small


def test_the_contact_beside_a_large_shadow_has_its_own_probability() -> None:
    shadow = changed(100.0, 1.0)
    contact = tactflow.stage("hull").process(MASK, None, shadow)
    first, second = contact.separate
    assert first.region_area > second.region_area
    assert first.probability < second.probability
    assert (contact.center, contact.probability) == (second.center, second.probability)


def test_the_reflection_of_a_contact_does_not_widen_its_hull() -> None:
    scene, seen = tactflow.open_scene("box?frames=24&stray=0.8"), 0
    settings = {"sinks.zmq": None, "sinks.view": None}
    for result in tactflow.stream("default", source="sim:box?frames=24&stray=0.8", settings=settings):
        truth = scene.truth(result.seq, result["mapping"])
        if truth.touching and result.contact is not None:
            assert np.hypot(*np.subtract(result.contact.center, truth.center)) < 1
            seen += 1
    assert seen > 2
