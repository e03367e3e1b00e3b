"""What a run of the bench measured, its JSON, and the comparison with a stored run."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tactflow.engine.errors import ConfigError
from tactflow.tools.bench.costs import Costs
from tactflow.tools.bench.growth import Growth
from tactflow.tools.bench.latency import percentiles
from tactflow.tools.bench.quantities import QUANTITIES

SCHEMA = "tactflow.bench/3"

PIPELINE = "pipeline"
"""Group of the rows about whole pipelines."""
TRUTH = "truth"
"""What the pictures of a scene show beside the pipelines."""
CLASSIC = "classic"
"""Name of the pipeline that is the yardstick: the original script."""
UNSKIPPED = ", nothing skipped"
"""What stands behind the name of a pipeline that works on every frame in full."""
TIMES = {"contact": "contact_ms", "idle": "idle_ms"}
"""Kind of frame -> quantity that is its median CPU time, ms."""
LEFT_OUT = "frames_left_out"
"""Quantity that counts the frames a method was too slow for; there is none if it was measured on all."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """The numbers of one method on one scene.

    Attributes
    ----------
    group : what is compared: "pipeline", or the id of a stage.
    method : name of the pipeline, or of the way to do the stage's work.
    scene : simulated scene.
    values : finite numbers: errors by their keys in `QUANTITIES`; median CPU times by those in `TIMES`, and
        their quartiles with `_low` and `_high` behind; "frames", the number of frames; and `LEFT_OUT`.
    """

    group: str
    method: str
    scene: str
    values: Mapping[str, float]

    @property
    def key(self) -> str:
        """group/method/scene."""
        return f"{self.group}/{self.method}/{self.scene}"

    @property
    def errors(self) -> dict[str, float]:
        """The values that are errors, not times or counts."""
        return {key: value for key, value in self.values.items() if key in QUANTITIES}

    @property
    def time_ms(self) -> float | None:
        """Median CPU time of a frame with contact, ms; of one without where no frame had contact."""
        return self.values.get(TIMES["contact"], self.values.get(TIMES["idle"]))


@dataclass(slots=True)
class BenchResult:
    """A whole run of the bench.

    Attributes
    ----------
    quick : whether it was the short one.
    machine : what it ran on.
    wall_s : how long the run took, s.
    failures : group/method/scene -> why there are no numbers.
    costs : pipeline -> kind of frame -> stage -> median CPU time, ms.
    grasp : name, and pipeline -> the frames of a recording, for the page.
    growth : cost of a frame against sizes.
    latency_ms : ages of results at a camera's pace.
    pictures : scene -> pipeline (or `TRUTH`) -> JPEG of its deepest frame, for the page; not in the JSON.
    """

    quick: bool
    machine: dict[str, str] = field(default_factory=dict[str, str])
    wall_s: float = 0.0
    measured: list[Measurement] = field(default_factory=list[Measurement])
    failures: dict[str, str] = field(default_factory=dict[str, str])
    costs: dict[str, dict[str, dict[str, float]]] = field(default_factory=dict)
    grasp: tuple[str, dict[str, Costs]] | None = None
    growth: list[Growth] = field(default_factory=list[Growth])
    latency_ms: list[float] = field(default_factory=list[float])
    pictures: dict[str, dict[str, bytes]] = field(default_factory=dict)

    def add(
        self,
        group: str,
        method: str,
        scene: str,
        errors: Mapping[str, float],
        *,
        times: Mapping[str, Collection[float]] | None = None,
        frames: int,
        left_out: int = 0,
    ) -> None:
        """Add the errors of a method on a scene, and the quartiles of CPU times, s, of each kind of frame.

        frames : number of measured frames. left_out : of those that the method was too slow for.
        """
        values = dict(errors)
        for kind, quantity in TIMES.items():
            if samples := (times or {}).get(kind):
                low, middle, high = np.quantile(1e3 * np.array(list(samples)), [0.25, 0.5, 0.75])
                values |= {
                    quantity: float(middle),
                    f"{quantity}_low": float(low),
                    f"{quantity}_high": float(high),
                }
        values["frames"] = float(frames)
        if left_out:
            values[LEFT_OUT] = float(left_out)
        self.measured.append(Measurement(group, method, scene, values))

    def measurements(self, group: str) -> list[Measurement]:
        """The numbers of one group, in the order in which they were measured."""
        return [measurement for measurement in self.measured if measurement.group == group]

    def save(self, path: Path) -> None:
        """Write everything as JSON, one measurement a line."""
        left_out = ("measured", "grasp", "pictures", "latency_ms")
        run = {name: value for name, value in asdict(self).items() if name not in left_out}
        run["latency_ms"] = percentiles(self.latency_ms)
        values = [f'"{m.key}": {json.dumps(m.values, allow_nan=False)}' for m in self.measured]
        head = json.dumps({"schema": SCHEMA, **run}, allow_nan=False)
        lines = ",\n".join(values)
        path.write_text(f'{head[:-1]}, "values": {{\n{lines}\n}}}}\n', encoding="utf-8")


def load_stored(path: Path, command: str, schema: str, content: str) -> dict[str, Any]:
    """The result of a command. Raises ConfigError unless the file has its schema and content."""
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from error
    if not isinstance(stored, dict) or stored.get("schema") != schema or content not in stored:
        raise ConfigError(f'{path}: not a result of `tactflow {command}` (required "schema": "{schema}")')
    return stored


def load_errors(path: Path, *, quick: bool) -> dict[str, dict[str, float]]:
    """Errors of a stored run: group/method/scene -> quantity -> error.

    Without those of methods that were too slow for all frames: which frames those are depends on the machine.
    Raises ConfigError if the file is not a result of the bench, or of a quick run while this one is full, or
    the other way round, because their scenes differ.
    """
    stored = load_stored(path, "bench", SCHEMA, "values")
    if stored["quick"] != quick:
        kind = "quick" if stored["quick"] else "full"
        raise ConfigError(f"{path}: is the result of a {kind} run; compare it with a {kind} run")
    return {
        key: {name: value for name, value in values.items() if name in QUANTITIES}
        for key, values in stored["values"].items()
        if LEFT_OUT not in values
    }


def regressions(
    result: BenchResult,
    stored: Mapping[str, Mapping[str, float]],
    scenes: Collection[str] | None = None,
) -> list[str]:
    """In words, every error that is worse than in a stored run by more than its tolerance, or missing.

    stored : of `load_errors`. scenes : the simulated scenes that were chosen, or None for all.
    """
    now = {m.key: m.errors for m in result.measured}
    incomplete = {m.key for m in result.measured if LEFT_OUT in m.values}
    worse = []
    for key, errors in stored.items():
        scene = key.rpartition("/")[2]
        if key in incomplete or (scenes is not None and scene not in scenes):
            continue
        for name, value in errors.items():
            quantity, current = QUANTITIES[name], now.get(key, {}).get(name)
            if current is None or quantity.is_worse(current, value):
                found = "no longer measured" if current is None else f"now {current:.4g}"
                allowed = quantity.allowed(value)
                worse.append(f"{key}: {quantity.title}: was {value:.4g}, allowed {allowed:.4g}, {found}")
    return worse
