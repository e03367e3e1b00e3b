"""Which thread the operating system runs first."""

from __future__ import annotations

import ctypes
import platform
import struct
from typing import Any

_CALLS = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of the system calls `sched_setattr` and `sched_getattr`, which the C library does not name."""
_ATTRIBUTES = struct.Struct("<IIQiIQQQ")
"""size, policy, flags, nice, priority, runtime, deadline, period: Linux's `struct sched_attr`."""
_ORDINARY = 0
"""The policy SCHED_OTHER, for which `runtime` is the length of a slice."""
SHORTEST = 100_000
"""The shortest slice that Linux knows, ns."""


def serve_soon(slice_ns: int = SHORTEST) -> bool:
    """Ask for short slices of the processor for this thread, so that it is run soon once it has work.

    A thread that wants little and at once (work on a frame) otherwise waits behind one that wants much (a
    browser, a renderer) until that one's slice is over, some 3 ms. Nobody gets less of the processor in all:
    this is how Linux's scheduler is told one from the other (EEVDF; I. Stoica and H. Abdel-Wahab, "Earliest
    Eligible Virtual Deadline First", 1995; slices can be asked for from Linux 6.12 on). Needs no rights.

    slice_ns : length of a slice, 100 000 to 100 000 000 ns.
    Returns whether it was granted. On other systems, on older kernels and for threads under another policy
    nothing changes.
    """
    if platform.system() != "Linux" or platform.machine() not in _CALLS:
        return False
    put, get = _CALLS[platform.machine()]
    call: Any = ctypes.CDLL(None).syscall
    held = ctypes.create_string_buffer(_ATTRIBUTES.size)
    if call(get, 0, held, _ATTRIBUTES.size, 0) != 0:
        return False
    size, policy, flags, nice, priority, *_ = _ATTRIBUTES.unpack(held.raw)
    if policy != _ORDINARY:
        return False
    wanted = _ATTRIBUTES.pack(size, policy, flags, nice, priority, slice_ns, 0, 0)
    if call(put, 0, ctypes.create_string_buffer(wanted, _ATTRIBUTES.size), 0) != 0:
        return False
    # Older kernels take any number and keep none.
    done = call(get, 0, held, _ATTRIBUTES.size, 0) == 0
    return bool(done and _ATTRIBUTES.unpack(held.raw)[5] == slice_ns)
