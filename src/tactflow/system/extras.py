"""Missing packages of extras."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

from tactflow.system.spelling import joined


def missing(feature: str, extra: str, modules: Sequence[str]) -> str | None:
    """A message about packages that are not installed, with the remedy; None if all are.

    feature : in the plural. extra : of tactflow, as in `pip install 'tactflow[record]'`. modules : required
    top-level modules.

    >>> missing("recordings", "record", ["json", "no_such_module"])
    "recordings need no_such_module: pip install 'tactflow[record]'"
    """
    absent = [name for name in modules if importlib.util.find_spec(name) is None]
    if not absent:
        return None
    return f"{feature} need {joined(absent)}: pip install 'tactflow[{extra}]'"
