"""What the program knows of a command before it is used."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType


@dataclass(frozen=True, slots=True)
class Command:
    """A command of the program, from the core or from the entry point group `tactflow.commands`.

    Attributes
    ----------
    summary : what it does, a phrase.
    module : imported when the command is used.
    name : of its functions in that module: `add_arguments(parser)` and `run(args) -> exit code`, or, with a
        name, `add_arguments_NAME` and `run_NAME`.
    """

    summary: str
    module: str
    name: str = ""

    def load(self) -> ModuleType:
        """Import its module."""
        return import_module(self.module)

    @property
    def suffix(self) -> str:
        """End of the names of its functions."""
        return f"_{self.name}" if self.name else ""
