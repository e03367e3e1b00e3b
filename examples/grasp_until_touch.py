"""Close a gripper until contact, hold the object, and tighten while it slips.

    tactflow run --realtime --source sim:stick_slip --set 'stages.slip={}'
    python examples/grasp_until_touch.py

Gripper and sensor are simulated, and the sensor does not respond to the gripper: replace `Gripper` with your
own.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable

from tactflow import Result, Subscriber

CLOSING = 30.0
"""Closing speed without contact, mm/s."""
TIGHTENING = 3.0
"""Closing speed while the object slips, mm/s."""
MAX_STEP = 0.1
"""Maximum duration of a motion per result, s."""
TIMEOUT = 10.0
"""Maximum time without a result before the program stops, s."""


class Gripper:
    """A simulated gripper. width : distance between its fingers, mm."""

    def __init__(self, width: float = 80.0) -> None:
        self.width = width

    def close_by(self, step: float) -> None:
        """Close by a distance, mm, until fully closed."""
        self.width = max(self.width - step, 0.0)


def grasp(gripper: Gripper, results: Iterable[Result]) -> None:
    """Close until contact, then hold; prints changes of state."""
    previous, last = None, None
    for result in results:
        slip, t = result.slip, result.t
        seconds = 0.0 if last is None else min(max(t - last, 0.0), MAX_STEP)
        last = t
        if result.contact is None:
            state = "closing"
            gripper.close_by(CLOSING * seconds)
        elif slip is not None and slip.slipping:
            state = "slips, tightening"
            gripper.close_by(TIGHTENING * seconds)
        else:
            state = "holding"
        if state != previous:
            print(f"{t:7.2f} s  {gripper.width:6.2f} mm  {state}", flush=True)
            previous = state


def main() -> None:
    """Receive results of a running tactflow until it ends."""
    parser = argparse.ArgumentParser(description="Close a simulated gripper until touch, hold against slip.")
    parser.add_argument(
        "endpoint", nargs="?", default="tcp://127.0.0.1:5556", help="address of tactflow's results"
    )
    endpoint = parser.parse_args().endpoint
    # Control needs the newest result: older ones are skipped.
    with Subscriber(endpoint, latest=True, timeout=TIMEOUT) as results:
        try:
            grasp(Gripper(), results)
        except TimeoutError as error:
            raise SystemExit(f"the gripper stays as it is: {error}") from None


if __name__ == "__main__":
    main()
