"""A kernel beside its plain version: the entries of the table of gains, how they are found and checked."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

import tactflow
import tests.oracles
from tactflow.vision.compiled import Kernel
from tests.oracles.typical import Arguments, duplicate, typical_arguments


@dataclass(frozen=True)
class Gain:
    """A kernel and the plain version of what it computes.

    Attributes
    ----------
    kernel : the compiled one.
    plain : numpy and OpenCV; takes the same arguments, returns the same and fills the same arrays.
    tolerance : largest difference between numbers of the two, in the unit of the number.
    outliers : share of the numbers of an array that may differ by more, such as pixels on an edge that
        rounding decides.
    scratch : names of the parameters whose content after the call means nothing.
    arguments : makes the arguments of a typical call. Without it they are recorded from the shipped
        pipelines, see `typical_arguments`.
    """

    kernel: Kernel[..., Any]
    plain: Callable[..., Any]
    tolerance: float = 0.0
    outliers: float = 0.0
    scratch: tuple[str, ...] = ()
    arguments: Callable[[], Arguments] | None = None

    @property
    def name(self) -> str:
        """Dotted name of the kernel."""
        return self.kernel.name

    def typical(self) -> Arguments:
        """Arguments of a typical call; the caller may write into them."""
        return self.arguments() if self.arguments else typical_arguments(self.name)

    def differences(self) -> list[str]:
        """Where the two disagree on typical arguments, one sentence each."""
        given = self.typical()
        ours, theirs = duplicate(given), duplicate(given)
        returned = self.kernel(*ours), self.plain(*theirs)
        names = list(inspect.signature(self.kernel.plain).parameters)
        pairs = [("the returned value", *returned)]
        pairs += [pair for pair in zip(names, ours, theirs, strict=True) if pair[0] not in self.scratch]
        return [said for said in (self._difference(*pair) for pair in pairs) if said]

    def _difference(self, name: str, ours: Any, theirs: Any) -> str | None:
        if ours is None and theirs is None:
            return None
        # Memory that a kernel leaves as it was may hold any bits, also those that are no number.
        with np.errstate(invalid="ignore", over="ignore"):
            one, other = np.asarray(ours, np.float64), np.asarray(theirs, np.float64)
        near = np.isclose(one, other, rtol=0, atol=self.tolerance, equal_nan=True)
        if near.all() or (near.size > 1 and np.mean(~near) <= self.outliers):
            return None
        with np.errstate(invalid="ignore"):
            most = np.nanmax(np.abs(one - other))
        return f"{self.name}: {name} differs in {np.sum(~near)} of {near.size} numbers, by up to {most:.3g}"


def kernels() -> dict[str, Kernel[..., Any]]:
    """Dotted name -> each kernel of the package."""
    found: dict[str, Kernel[..., Any]] = {}
    for module in _modules(tactflow):
        for value in vars(module).values():
            if isinstance(value, Kernel) and value.plain.__module__ == module.__name__:
                found[value.name] = value
    return found


def gains() -> list[Gain]:
    """All entries of the oracle modules, by name."""
    entries = [entry for module in _modules(tests.oracles) for entry in getattr(module, "GAINS", [])]
    return sorted(entries, key=lambda entry: entry.name)


def _modules(package: ModuleType) -> Iterator[ModuleType]:
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        if not found.name.endswith("__main__"):
            yield import_module(found.name)
