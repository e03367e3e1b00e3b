"""Real-time priority for the threads of live frames, where a pipeline asks: `realtime_priority: true`.

An ordinary scheduler shares the processor out evenly: a thread that works on a frame may wait milliseconds
for a browser. Under SCHED_RR it goes first. That takes a right (root's, or a limit `rtprio` for the user);
Linux itself keeps such threads from taking all there is (`/proc/sys/kernel/sched_rt_runtime_us`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection


def ask_for_realtime(threads: Collection[int]) -> str | None:
    """Give threads of this process the lowest real-time priority, SCHED_RR 1.

    What they start themselves, other programs among them, stays ordinary.

    threads : their native ids.
    Returns None if all have it, else why not, in words.
    """
    if sys.platform != "linux":
        return f"there is none on {sys.platform}"
    lowest = os.sched_param(os.sched_get_priority_min(os.SCHED_RR))
    try:
        for thread in threads:
            os.sched_setscheduler(thread, os.SCHED_RR | os.SCHED_RESET_ON_FORK, lowest)
    except OSError as error:
        return f"{error.strerror}; root has the right, others get it with the limit rtprio"
    return None
