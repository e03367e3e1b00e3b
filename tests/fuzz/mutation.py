"""Damage to valid bytes, the same for the same seed."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence

MOST_DAMAGE = 6
"""Mutations of one input at most. Chosen by hand."""
LONGEST = 1 << 20
"""Bytes of an input at most: repetition would make it grow without end."""
TELLING = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
"""Numbers at which lengths and counts overflow."""


class Mutator:
    """Makes inputs from valid samples: most are damaged a little, so that parsers get far into them.

    >>> Mutator([b"abc"], seed=1).next() == Mutator([b"abc"], seed=1).next()
    True
    """

    def __init__(self, samples: Sequence[bytes], seed: int) -> None:
        self._samples = samples
        self._random = random.Random(seed)
        self._ways: Sequence[Callable[[bytearray], None]] = (
            *(self._flip, self._set, self._number, self._number),
            *(self._remove, self._repeat, self._insert, self._splice, self._cut, self._digits),
        )

    def next(self) -> bytes:
        """The next input."""
        data = bytearray(self._random.choice(self._samples))
        for _ in range(self._random.randint(1, MOST_DAMAGE)):
            self._random.choice(self._ways)(data)
        return bytes(data[:LONGEST])

    def _place(self, data: bytearray) -> int:
        """Half of all places are near the beginning, where headers are."""
        size = len(data) if self._random.random() < 0.5 else min(len(data), 128)
        return self._random.randrange(size) if size else 0

    def _part(self, data: bytearray) -> slice:
        start = self._place(data)
        return slice(start, start + self._random.choice((1, 2, 4, 8, 64, 1024)))

    def _flip(self, data: bytearray) -> None:
        if data:
            data[self._place(data)] ^= 1 << self._random.randrange(8)

    def _set(self, data: bytearray) -> None:
        if data:
            data[self._place(data)] = self._random.randrange(256)

    def _number(self, data: bytearray) -> None:
        start, size = self._place(data), self._random.choice((1, 2, 4, 8))
        order = self._random.choice(("little", "big"))
        number = self._random.choice(TELLING) & ((1 << 8 * size) - 1)
        data[start : start + size] = number.to_bytes(size, "little" if order == "little" else "big")

    def _remove(self, data: bytearray) -> None:
        del data[self._part(data)]

    def _repeat(self, data: bytearray) -> None:
        part = self._part(data)
        data[part.start : part.start] = data[part] * self._random.choice((1, 2, 100))

    def _insert(self, data: bytearray) -> None:
        start = self._place(data)
        data[start:start] = self._random.randbytes(self._random.choice((1, 4, 32)))

    def _splice(self, data: bytearray) -> None:
        other = self._random.choice(self._samples)
        data[self._part(data)] = other[self._part(bytearray(other))]

    def _cut(self, data: bytearray) -> None:
        del data[self._place(data) :]

    def _digits(self, data: bytearray) -> None:
        """Another number in text."""
        places = [index for index, byte in enumerate(data[:4096]) if 0x30 <= byte <= 0x39]
        if places:
            start = self._random.choice(places)
            number = self._random.choice((*TELLING, -1, 1e308, "nan"))
            data[start : start + 1] = str(number).encode()
