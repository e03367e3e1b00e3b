"""Close a gripper until something touches it, then hold it, and tighten while it slips.

    tactflow run --realtime --source sim:stick_slip --set 'stages.slip={}'
    python examples/grasp_until_touch.py

The gripper is simulated, and so is the sensor, which shows the same whatever the gripper does: put your own
gripper in the place of `Gripper`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from tactflow import Result, Subscriber

CLOSING = 30.0
"""How fast the gripper closes while nothing touches, mm/s."""
TIGHTENING = 3.0
"""How fast it closes while the object slips, mm/s."""
LONGEST_STEP = 0.1
"""Nobody moves for longer on one result, s."""
SILENCE = 10.0
"""Without results for so long, nobody may move on what was felt last, s."""


class Gripper:
    """A gripper that does as it is told. width : between its fingers, mm."""

    def __init__(self, width: float = 80.0) -> None:
        self.width = width

    def close_by(self, step: float) -> None:
        """Go on closing, mm; not beyond closed."""
        self.width = max(self.width - step, 0.0)


def grasp(gripper: Gripper, results: Iterable[Result]) -> None:
    """Close until touch, then hold; says when that changes. results : as received from tactflow."""
    before, last = None, None
    for result in results:
        slip, t = result.slip, result.t
        seconds = 0.0 if last is None else min(max(t - last, 0.0), LONGEST_STEP)
        last = t
        if result.contact is None:
            state = "closing"
            gripper.close_by(CLOSING * seconds)
        elif slip is not None and slip.slipping:
            state = "slips, tightening"
            gripper.close_by(TIGHTENING * seconds)
        else:
            state = "holding"
        if state != before:
            print(f"{t:7.2f} s  {gripper.width:6.2f} mm  {state}", flush=True)
            before = state


def main() -> None:
    """Listen to a running tactflow until it ends."""
    parser = argparse.ArgumentParser(description="Close a simulated gripper until touch, hold against slip.")
    parser.add_argument(
        "endpoint", nargs="?", default="tcp://127.0.0.1:5556", help="where tactflow publishes"
    )
    endpoint = parser.parse_args().endpoint
    # What a gripper acts on is the present: whatever came meanwhile is skipped.
    with Subscriber(endpoint, latest=True, timeout=SILENCE) as results:
        try:
            grasp(Gripper(), results)
        except TimeoutError as error:
            raise SystemExit(f"the gripper stays as it is: {error}") from None


if __name__ == "__main__":
    main()
