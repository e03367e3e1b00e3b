"""Memory of freed pictures."""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

BLOCK_BYTES: Final = 31 << 20
"""Size of a block up to which freed memory is kept: just below the most that glibc allows, 32 MiB."""


@cache
def keep_freed_memory() -> None:
    """Let the C library keep the memory of freed pictures for the next ones.

    At first glibc maps each block of 128 KiB or more anew and returns it when it is freed. Every page of it
    then costs a fault when it is first touched, together more than it costs to halve a picture. Once a larger
    block has been freed, glibc keeps blocks up to that size (`man mallopt`, M_MMAP_THRESHOLD). The block
    itself is never touched, so it takes no memory. Other C libraries are not affected.
    """
    np.empty(BLOCK_BYTES, np.uint8)
