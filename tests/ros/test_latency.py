"""At the rate of a camera, no message is lost on the way into ROS."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.ros.latency import measure
from tests.ros.programs import needs_rclpy


@needs_rclpy
@pytest.mark.slow
def test_every_message_of_a_minute_at_60_hz_reaches_a_subscriber_with_its_capture_time(
    tmp_path: Path,
) -> None:
    passage = measure(60.0, tmp_path)
    assert passage.received == passage.sent
    assert passage.stamps_equal
