"""Names of files that replace none."""

from __future__ import annotations

import os
import re
from pathlib import Path


def next_name(path: Path) -> Path:
    """The first numbered name after those that are taken: press.mcap, press-001.mcap, press-002.mcap ...

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     Path(folder, "press-007.mcap").touch()
    ...     print(next_name(Path(folder, "press.mcap")).name)
    press-008.mcap
    """
    taken = 0
    pattern = re.compile(re.escape(path.stem) + r"-(\d+)" + re.escape(path.suffix))
    if path.parent.is_dir():
        for name in os.listdir(path.parent):
            found = pattern.fullmatch(name)
            taken = max(taken, int(found[1]) if found else 0)
    return path.with_name(f"{path.stem}-{taken + 1:03d}{path.suffix}")
