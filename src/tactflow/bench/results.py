"""What a run of the bench found, and how it is stored (`bench.json`)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tactflow.engine.errors import ConfigError

SCHEMA = "tactflow.bench/1"

RECORDING = "data:"
"""What the scene name of a real recording starts with."""


@dataclass(slots=True)
class Measurement:
    """One method on one scene.

    group : what is compared ("pipeline", "marker_mask", "inpaint", "difference", "hull", "tracker", ...).
    method : the alternative's name. scene : what it was run on. frames : how many.
    time : kind ("contact", "idle", or "all") -> percentiles in ms; see `timing.Samples.summary`.
    copies : kind -> median CPU time in copies of a raw frame.
    faster : kind -> how many times faster than the original script in the same group in the same run.
    errors : quantity -> value; only what the scene can tell.
    limits : quantity -> the smallest value that physics allows.
    stages_ms : stage -> median time of a call, ms; whole pipelines only.
    peak_mb : peak memory of the process, MB; whole pipelines only.
    failure : why there is no result, or None.
    """

    group: str
    method: str
    scene: str
    frames: int = 0
    time: dict[str, dict[str, float]] = field(default_factory=dict)
    copies: dict[str, float] = field(default_factory=dict)
    faster: dict[str, float] = field(default_factory=dict)
    errors: dict[str, float] = field(default_factory=dict)
    limits: dict[str, float] = field(default_factory=dict)
    stages_ms: dict[str, float] = field(default_factory=dict)
    peak_mb: float | None = None
    failure: str | None = None

    @property
    def key(self) -> str:
        """Name of the measurement: group/method/scene."""
        return f"{self.group}/{self.method}/{self.scene}"


@dataclass(slots=True)
class Target:
    """A promise and what became of it.

    quantity : what was promised. target : the promise in words. result : what was measured, in words.
    met : True, False, or None where it was not measured. on : scenes and method behind the result.
    """

    quantity: str
    target: str
    result: str
    met: bool | None
    on: str = ""


@dataclass(slots=True)
class Result:
    """A whole run of the bench.

    quick : whether it was the short one. machine : what it ran on. copy_ms, touch_ms : the unit of time and
    the cost of touching every byte of a raw frame once, ms. fault_us : the cost of a page of fresh memory,
    us. wall_s : how long the run took.
    """

    quick: bool
    machine: dict[str, str] = field(default_factory=dict)
    copy_ms: float = math.nan
    touch_ms: float = math.nan
    fault_us: float = math.nan
    wall_s: float = 0.0
    measurements: list[Measurement] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)

    def groups(self) -> list[str]:
        """The groups in the order in which they were measured."""
        return list(dict.fromkeys(m.group for m in self.measurements))

    def of(self, group: str, method: str | None = None) -> list[Measurement]:
        """The measurements of a group, or of one method in it."""
        return [m for m in self.measurements if m.group == group and method in (None, m.method)]

    def methods(self, group: str) -> list[str]:
        """The methods of a group in the order in which they were measured."""
        return list(dict.fromkeys(m.method for m in self.of(group)))

    def to_json(self) -> dict[str, Any]:
        """As plain data; numbers that are not finite become null."""
        return {"schema": SCHEMA, **_finite(asdict(self))}

    def save(self, path: Path) -> None:
        """Write as JSON."""
        path.write_text(json.dumps(self.to_json(), indent=1) + "\n", encoding="utf-8")

    def save_errors(self, path: Path) -> None:
        """Write only what does not depend on the machine: the errors, to compare a later run with."""
        errors = {
            m.key: {name: float(f"{value:.6g}") for name, value in sorted(m.errors.items())}
            for m in self.measurements
            if m.errors
        }
        stored = {"schema": SCHEMA, "quick": self.quick, "errors": errors}
        path.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return value


def load_errors(path: Path) -> tuple[bool, dict[str, dict[str, float]]]:
    """Read a stored result, whole or errors only.

    Returns
    -------
    (quick, errors) : whether it was a quick run, and measurement key -> quantity -> value.

    Raises
    ------
    ConfigError
        If the file cannot be read or is not a result of the bench.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not JSON: {error}") from error
    if not isinstance(stored, dict) or stored.get("schema") != SCHEMA:
        raise ConfigError(f'{path}: not a result of `tactflow bench` (required "schema": "{SCHEMA}")')
    errors: dict[str, dict[str, float]] = {}
    if "errors" in stored:
        errors = stored["errors"]
    else:
        for m in stored["measurements"]:
            if m["errors"]:
                errors[f"{m['group']}/{m['method']}/{m['scene']}"] = m["errors"]
    return bool(stored.get("quick")), errors
