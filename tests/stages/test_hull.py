"""Stage `hull`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.frame import Absent
from tactflow.stages.hull import Hull
from tactflow.vision.types import Contact


def run(mask: NDArray[np.uint8], **params: Any) -> Contact | Absent:
    mask.flags.writeable = False
    return Hull(Hull.Params(**params)).process(mask)


def bar(height: int = 10) -> NDArray[np.uint8]:
    mask = np.zeros((60, 90), np.uint8)
    mask[20 : 20 + height, 10:60] = 255
    return mask


def test_an_empty_mask_is_no_contact() -> None:
    assert run(np.zeros((60, 90), np.uint8)) == Absent("no_contact")


def test_the_contact_tells_what_showed_it() -> None:
    stage = Hull(Hull.Params())
    told = [stage.process(bar(), evidence) for evidence in (None, "dots", "both")]
    assert [contact.evidence for contact in told if isinstance(contact, Contact)] == ["light", "dots", "both"]


def test_what_is_smaller_than_min_area_is_no_contact() -> None:
    assert run(bar(), min_area=501) == Absent("no_contact")
    assert isinstance(run(bar(), min_area=500), Contact)


def two() -> NDArray[np.uint8]:
    mask = bar()
    mask[20:30, 80:85] = 255
    return mask


def test_the_core_has_an_area_of_its_own_where_it_is_known() -> None:
    stage, core = Hull(Hull.Params()), two()
    core[:25] = 0
    contact = stage.process(two(), "light", None, core)
    assert isinstance(contact, Contact)
    assert [part.core_area for part in contact.separate] == [250, 25]
    # From the left end of one to the right end of the other.
    assert contact.core_area == 5 * 75
    for evidence, known in (("dots", core), ("light", None), ("light", np.zeros_like(core))):
        unknown = stage.process(bar(), evidence, None, known)
        assert isinstance(unknown, Contact)
        assert unknown.core_area is None


@pytest.mark.parametrize(("params", "right"), [({}, 84), ({"merge": "largest"}, 59)], ids=str)
def test_separate_contacts_are_told_whatever_the_contact_is(params: Any, right: int) -> None:
    contact = run(two(), **params)
    assert contact.hull[:, 0].max() == right
    assert [part.region_area for part in contact.separate] == [500, 50]
    assert [part.separate for part in contact.separate] == [(), ()]


def test_a_stubby_contact_has_no_direction_unless_asked_for() -> None:
    stubby = run(bar(height=39))
    assert stubby.angle is None
    asked = run(bar(height=39), min_confidence=0)
    assert asked.angle == 0.0
