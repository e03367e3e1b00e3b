"""Packages that only some need: each set is an extra of tactflow, `pip install 'tactflow[record]'`."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence


def missing(what: str, extra: str, modules: Sequence[str]) -> str | None:
    """Why something cannot be done here and what to do about it, or None.

    what : in the plural, at the beginning of the sentence. modules : that must be there, top level.

    >>> missing("recordings", "record", ["json", "no_such_module"])
    "recordings need no_such_module: pip install 'tactflow[record]'"
    """
    absent = [name for name in modules if importlib.util.find_spec(name) is None]
    if not absent:
        return None
    return f"{what} need {' and '.join(absent)}: pip install 'tactflow[{extra}]'"
