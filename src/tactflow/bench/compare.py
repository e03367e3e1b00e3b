"""Is it still as good as it was? Errors against those of a stored run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from tactflow.bench.quantities import QUANTITIES
from tactflow.bench.results import RECORDING, Result, load_errors
from tactflow.engine.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Regression:
    """A quantity that got worse. now : None if it is no longer measured."""

    measurement: str
    quantity: str
    stored: float
    allowed: float
    now: float | None

    def __str__(self) -> str:
        title = QUANTITIES[self.quantity].title if self.quantity in QUANTITIES else self.quantity
        now = "no longer measured" if self.now is None else f"now {self.now:.4g}"
        return f"{self.measurement}: {title}: was {self.stored:.4g}, allowed {self.allowed:.4g}, {now}"


def regressions(
    now: Mapping[str, Mapping[str, float]], stored: Mapping[str, Mapping[str, float]]
) -> list[Regression]:
    """Every quantity of `stored` that is worse in `now`, or missing there.

    Parameters
    ----------
    now, stored : measurement key -> quantity -> value.
    """
    found = []
    for key, quantities in stored.items():
        for name, value in quantities.items():
            quantity = QUANTITIES.get(name)
            if quantity is None:
                continue
            current = now.get(key, {}).get(name)
            if current is None or quantity.is_worse(current, value):
                found.append(Regression(key, name, value, quantity.allowed(value), current))
    return found


def load_comparable(path: Path, quick: bool) -> dict[str, dict[str, float]]:
    """Errors of a stored run of the same kind, by measurement.

    Raises
    ------
    ConfigError
        If the stored run is unreadable, or one is quick and the other is not: they differ in their scenes.
    """
    was_quick, stored = load_errors(path)
    if was_quick != quick:
        kind = "quick" if was_quick else "full"
        raise ConfigError(f"{path}: is the result of a {kind} run; compare it with a {kind} run")
    return stored


def against(result: Result, path: Path, scenes: Collection[str] | None = None) -> list[Regression]:
    """Compare a run with a stored one of the same kind.

    Parameters
    ----------
    scenes : the simulated scenes that were chosen, or None for all.

    Raises
    ------
    ConfigError
        As `load_comparable`.
    """
    here = {m.scene for m in result.measurements}
    comparable = {}
    for key, value in load_comparable(path, result.quick).items():
        scene = key.rsplit("/", 1)[-1]
        # Recordings are not everywhere; simulated scenes are, so a missing one is a regression.
        if scene in here or not (scene.startswith(RECORDING) or (scenes is not None and scene not in scenes)):
            comparable[key] = value
    return regressions({m.key: m.errors for m in result.measurements}, comparable)
