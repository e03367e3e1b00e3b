"""The layout of shared memory: a ring of slots, one ring per port. `docs/tactflow_shm.h` is the same in C.

The only writer never waits. Each slot has a stamp: 2 n while it holds the n-th picture of its ring, and an
odd number once it is withdrawn, which happens a whole frame before it is overwritten. So a reader whose stamp
is unchanged after use has seen a whole picture. System calls lie between the withdrawal and the overwriting,
and thousands of stores of the interpreter between the last pixel and the stamp, more than any processor holds
back, so that the order also holds on processors that reorder stores (ARM).
"""

from __future__ import annotations

import mmap
import os
import sys
import tempfile
import time
from contextlib import suppress
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

if sys.platform != "win32":
    import fcntl

MAGIC: Final = b"TACTSHM1"
"""First bytes of a ring; the digit is the version of the layout."""
RING: Final = np.dtype(
    [
        ("magic", "S8"),
        ("generation", "u8"),
        ("slots", "u8"),
        ("slot_bytes", "u8"),
        ("message_offset", "u8"),
        ("newest", "u8"),
    ]
)
"""Header of a ring, in the machine's own byte order."""
SLOT: Final = np.dtype(
    [
        ("stamp", "u8"),
        ("seq", "i8"),
        ("t", "f8"),
        ("data_bytes", "u8"),
        ("message_bytes", "u8"),
        ("ndim", "u8"),
        ("shape", "u8", (4,)),
        ("dtype", "S8"),
    ]
)
"""Header of a slot. `data_bytes` is 0 and `dtype` empty if the port is absent in this frame."""
MAX_DIMENSIONS: Final = 4
"""Axes of an array at most: the length of `shape`."""
FIRST_SLOT_BYTES: Final = 4096
"""Offset of the first slot, bytes: a page, so that the counters share none with pictures."""
DATA_OFFSET_BYTES: Final = 128
"""Offset of the array in its slot, bytes: the next multiple of two cache lines after the header."""
ALIGNMENT_BYTES: Final = 64
"""Alignment of messages and slots, bytes: a cache line, which is also enough for vector registers."""
MESSAGE_ROOM_FACTOR: Final = 2
"""Room for messages, relative to the first: they grow with contacts, and a larger ring is a new map."""
MIN_MESSAGE_BYTES: Final = 1 << 16
"""Room for a message at least, bytes: one with 400 dots has 30 kB."""
_FUTURE_WRITE_SEAL: Final = 0x10
"""Linux's F_SEAL_FUTURE_WRITE, which Python does not name: later maps of the memory are read-only."""


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT_BYTES) * ALIGNMENT_BYTES


Counters = NDArray[np.uint64]


class Picture(NamedTuple):
    """What is written into a slot.

    Attributes
    ----------
    array : the value of the port, up to four axes of numbers; None if it is absent in this frame.
    message : JSON in UTF-8.
    """

    seq: int
    t: float
    array: NDArray[Any] | None
    message: bytes


class Ring:
    """A ring of slots in memory without a name, for writing.

    The memory belongs to the processes that have it open, and is freed with the last of them, however they
    end.

    Parameters
    ----------
    first : the first picture, which decides about the sizes; it is not written. slots : 3 or more.

    Raises
    ------
    OSError : there is no memory.

    >>> picture = Picture(7, 0.5, np.zeros((60, 80, 3), np.uint8), b"{}")
    >>> ring = Ring(picture, slots=3)
    >>> ring.write(picture)
    >>> RingView(ring.descriptor).newest
    1
    """

    def __init__(self, first: Picture, slots: int) -> None:
        self._data_room = 0 if first.array is None else first.array.nbytes
        self._message_room = max(MIN_MESSAGE_BYTES, MESSAGE_ROOM_FACTOR * len(first.message))
        self._message_offset = _aligned(DATA_OFFSET_BYTES + self._data_room)
        self._slot_bytes = _aligned(self._message_offset + self._message_room)
        size = FIRST_SLOT_BYTES + slots * self._slot_bytes
        self.descriptor = _nameless_memory(size)
        self._map = mmap.mmap(self.descriptor, size)
        if sys.platform == "linux":
            # Old kernels do not know the last one; nothing depends on them but protection from mistakes.
            with suppress(OSError):
                seals = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | _FUTURE_WRITE_SEAL
                fcntl.fcntl(self.descriptor, fcntl.F_ADD_SEALS, seals)
        header = np.frombuffer(self._map, RING, 1)[0]
        header["generation"], header["slots"], header["slot_bytes"] = time.time_ns(), slots, self._slot_bytes
        header["message_offset"], header["magic"] = self._message_offset, MAGIC
        self._newest, self._stamps = _counters(self._map, slots, self._slot_bytes)

    def fits(self, picture: Picture) -> bool:
        """Whether there is room for this picture and its message."""
        size = 0 if picture.array is None else picture.array.nbytes
        return size <= self._data_room and len(picture.message) <= self._message_room

    def write(self, picture: Picture) -> None:
        """Write the next picture, and withdraw the slot that follows. Never waits."""
        number = int(self._newest[0]) + 1
        index = number % len(self._stamps)
        place = FIRST_SLOT_BYTES + index * self._slot_bytes
        slot = np.frombuffer(self._map, SLOT, 1, place)[0]
        array = picture.array
        if array is not None:
            target: NDArray[Any] = np.ndarray(array.shape, array.dtype, self._map, place + DATA_OFFSET_BYTES)
            np.copyto(target, array)
        begin = place + self._message_offset
        self._map[begin : begin + len(picture.message)] = picture.message
        shape = () if array is None else array.shape
        slot["seq"], slot["t"], slot["message_bytes"] = picture.seq, picture.t, len(picture.message)
        slot["data_bytes"] = 0 if array is None else array.nbytes
        slot["dtype"], slot["ndim"] = "" if array is None else array.dtype.str, len(shape)
        slot["shape"][: len(shape)] = shape
        self._stamps[index] = 2 * number
        self._newest[0] = number
        self._stamps[(number + 1) % len(self._stamps)] |= np.uint64(1)

    def close(self) -> None:
        """Give up the memory; readers keep theirs."""
        os.close(self.descriptor)


class RingView:
    """A ring of another process, for reading.

    descriptor : of the memory; it can be closed afterwards.

    Raises
    ------
    ValueError : the memory is not a ring of this version.
    """

    def __init__(self, descriptor: int) -> None:
        self._map = mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ)
        header = np.frombuffer(self._map, RING, 1)[0]
        if header["magic"] != MAGIC:
            raise ValueError(f"required a ring {MAGIC.decode()}, got {bytes(header['magic'])!r}")
        self.generation, self.slots = int(header["generation"]), int(header["slots"])
        self._slot_bytes, self._message_offset = int(header["slot_bytes"]), int(header["message_offset"])
        self._newest, self._stamps = _counters(self._map, self.slots, self._slot_bytes)

    @property
    def newest(self) -> int:
        """Number of the newest picture, from 1; 0 before the first."""
        return int(self._newest[0])

    @property
    def oldest(self) -> int:
        """Number of the oldest picture that may still be there, from 1."""
        return max(1, self.newest - self.slots + 2)

    def holds(self, number: int) -> bool:
        """Whether a picture has not been overwritten yet, nor withdrawn."""
        return int(self._stamps[number % self.slots]) == 2 * number

    def read(self, number: int) -> Picture | None:
        """A picture; None if it has been overwritten. Its array lies in the shared memory, read-only."""
        if not self.holds(number):
            return None
        index = number % self.slots
        place = FIRST_SLOT_BYTES + index * self._slot_bytes
        slot = np.frombuffer(self._map, SLOT, 1, place)[0].copy()
        begin = place + self._message_offset
        message = self._map[begin : begin + int(slot["message_bytes"])]
        if not self.holds(number):
            return None
        array = None
        if slot["dtype"]:
            shape = tuple(slot["shape"][: int(slot["ndim"])].tolist())
            array = np.ndarray(shape, slot["dtype"].decode(), self._map, place + DATA_OFFSET_BYTES)
        return Picture(int(slot["seq"]), float(slot["t"]), array, message)


def _counters(memory: mmap.mmap, slots: int, slot_bytes: int) -> tuple[Counters, Counters]:
    """`newest`, and the stamps of all slots. They are aligned, so that each is stored and loaded at once."""
    newest: Counters = np.ndarray((1,), np.uint64, memory, RING.fields["newest"][1])  # type: ignore[index]
    stamps: Counters = np.ndarray((slots,), np.uint64, memory, FIRST_SLOT_BYTES, strides=(slot_bytes,))
    return newest, stamps


def _nameless_memory(size: int) -> int:
    """A descriptor of memory without a name, so that nothing stays if all processes are killed."""
    if sys.platform == "linux":
        descriptor = os.memfd_create("tactflow", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    return descriptor
