"""The sequential test of slip."""

from __future__ import annotations

import pytest

from tactflow.vision.flow.slip_event import EventTest


@pytest.mark.parametrize(
    ("shares", "reports"),
    [
        ("0000000", "0000000"),
        ("1000000", "0000000"),
        ("0110000", "0011000"),
        ("0101000", "0001000"),
        ("1001001", "0000000"),
        ("1111011", "0111111"),
        ("1111001", "0111101"),
    ],
)
def test_a_report_needs_two_of_three_frames_and_outlasts_a_pause_of_one(shares: str, reports: str) -> None:
    test = EventTest()
    events = [test(seq / 60, float(share), "sliding") for seq, share in enumerate(shares)]
    assert "".join(str(int(event.slipping)) for event in events) == reports
    assert all((event.probability > 0.5) == event.slipping for event in events)


def test_weak_evidence_adds_up_over_more_frames() -> None:
    test = EventTest()
    reports = [test(seq / 60, 0.7, "creeping").slipping for seq in range(12)]
    assert 3 < reports.index(True) < 8


def test_the_onset_is_the_first_frame_with_evidence_and_the_kind_that_of_the_last() -> None:
    test = EventTest()
    test(0.0, 0.0, "sliding")
    assert test(0.1, 1.0, "lost").onset is None
    event = test(0.2, 1.0, "sliding")
    assert (event.kind, event.onset) == ("sliding", 0.1)
    assert test(0.3, 0.0, "creeping").kind == "sliding"
    test.reset()
    assert not test(0.4, 1.0, "sliding").slipping
