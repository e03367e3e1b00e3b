"""Damage to valid bytes, the same for the same seed."""

from __future__ import annotations

import random
from collections.abc import Sequence

MOST_DAMAGE = 6
"""Mutations of one input at most. Chosen by hand."""
LONGEST = 1 << 20
"""Bytes of an input at most: repetition would make it grow without end."""
BORDERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 62, (1 << 64) - 1)
"""Numbers at which lengths and counts overflow."""


class Mutator:
    """Makes inputs from valid samples: most are damaged a little, so that parsers get far into them.

    >>> Mutator([b"abc"], seed=1).next() == Mutator([b"abc"], seed=1).next()
    True
    """

    def __init__(self, samples: Sequence[bytes], seed: int) -> None:
        self._samples = samples
        self._random = random.Random(seed)

    def next(self) -> bytes:
        """The next input."""
        data = bytearray(self._random.choice(self._samples))
        for _ in range(self._random.randint(1, MOST_DAMAGE)):
            self._damage(data)
        return bytes(data[:LONGEST])

    def _part(self, data: bytearray) -> slice:
        """Some bytes; half of all places are near the beginning, where headers are."""
        size = len(data) if self._random.random() < 0.5 else min(len(data), 128)
        start = self._random.randrange(size) if size else 0
        return slice(start, start + self._random.choice((1, 2, 4, 8, 64, 1024)))

    def _damage(self, data: bytearray) -> None:
        choose, part = self._random.choice, self._part(data)
        way = self._random.randrange(9)
        if way == 0 and data:
            data[part.start] ^= 1 << self._random.randrange(8)
        elif way in (1, 2):
            size = choose((1, 2, 4, 8))
            number = choose(BORDERS) & ((1 << 8 * size) - 1)
            data[part.start : part.start + size] = number.to_bytes(size, choose(("little", "big")))
        elif way == 3:
            del data[part]
        elif way == 4:
            data[part.start : part.start] = data[part] * choose((1, 2, 100))
        elif way == 5:
            data[part.start : part.start] = self._random.randbytes(choose((1, 4, 32)))
        elif way == 6:
            sample = choose(self._samples)
            data[part] = sample[self._part(bytearray(sample))]
        elif way == 7:
            del data[part.start :]
        elif digits := [index for index, byte in enumerate(data[:4096]) if 0x30 <= byte <= 0x39]:
            start = choose(digits)
            data[start : start + 1] = str(choose((*BORDERS, -1, 1e308, "nan"))).encode()
