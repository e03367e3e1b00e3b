"""What a force calibration says of known loads: on another sensor of its kind, or on another day.

The elasticity of gels of one kind differs mostly by a factor, which known loads show.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from tactflow.calibration.file import Calibration, ForceEntry
from tactflow.calibration.force_samples import Watched, features_of_press
from tactflow.calibration.weights import Weighed
from tactflow.engine.errors import ConfigError
from tactflow.vision.arrays import Floats
from tactflow.vision.field_force import FieldForce
from tactflow.vision.force import ForceModel, Seen

FEWEST_LOADS_TO_CARRY: Final = 2
"""Loads from which a force part is carried to another sensor: their difference tests the factor."""
ALIKE_STDERRS: Final = 2.0
"""Standard errors up to which a factor counts as 1."""


class Gain(NamedTuple):
    """Known forces over those that a calibration says.

    value : their ratio, by least squares. stderr : of it, by the stated errors of the calibration, or by the
    scatter of the loads where that is larger. known, said, errors : (n,) N, of each load; errors
    are stated.
    """

    value: float
    stderr: float
    known: Floats
    said: Floats
    errors: Floats

    @property
    def is_one(self) -> bool:
        """Whether the gel answers as the calibration says."""
        return abs(self.value - 1) <= ALIKE_STDERRS * self.stderr


def gain(calibration: Calibration, weighed: Weighed) -> Gain:
    """Compare a force calibration with known loads.

    Raises ConfigError without a force part, or where what it needs is not seen.
    """
    entry = _comparable_force(calibration, weighed.watched)
    model = entry.model(calibration.field_force)
    found = [
        (force, *_said(model, weighed.watched, load))
        for load, force in zip(weighed.loads, weighed.forces, strict=True)
        if math.isfinite(force)
    ]
    if not found:
        raise ConfigError("calibrate: no load of known force was found; each must lie still for a second")
    known, said, errors = np.array(found).T
    if said.min() <= 0:
        raise ConfigError(
            "calibrate: the calibration says no force for a load: it is of another kind of sensor"
        )
    square = float(said @ said)
    value = float(known @ said) / square
    stated = value * math.sqrt(float(np.square(said * errors).sum())) / square
    scatter = math.sqrt(float(np.square(known - value * said).sum()) / max(len(known) - 1, 1) / square)
    return Gain(value, max(stated, scatter), known, said, errors)


def _comparable_force(calibration: Calibration, watched: Watched) -> ForceEntry:
    """The force part of a calibration. Raises ConfigError if there is none, or it needs what is not seen."""
    entry, field = calibration.force, calibration.field_force
    if entry is None:
        raise ConfigError("calibrate: the calibration has no force part")
    if entry.press is not None and not entry.press.stiffness.keys() <= watched.press.keys():
        raise ConfigError(
            "calibrate: heights are known here and not in the calibration, or the other way round"
        )
    if field is not None and watched.field is not None and watched.field[0].size != field.modes.shape[1]:
        raise ConfigError(
            "calibrate: the calibration measures the force by dots, for pictures of another aspect ratio"
        )
    return entry


def _said(model: ForceModel, watched: Watched, load: tuple[int, int]) -> tuple[float, float]:
    """The force of a load by a model, and its stated error, N: means over its frames."""
    forces = []
    features = features_of_press(watched, model.change_at_rest)
    for index in range(load[0], load[1] + 1):
        press = dict(zip(watched.press, features[index].tolist(), strict=True))
        moved = None if watched.field is None else watched.field[index]
        if moved is not None and np.isnan(moved).any():
            moved = None
        if model.press is None and moved is None:
            raise ConfigError("calibrate: the calibration measures the force by dots, and too few are seen")
        force = model.force(Seen(press, {}), moved)
        forces.append((force.value[2], force.stderr[2]))
    value, error = np.mean(forces, axis=0).tolist()
    return value, error


def at_rest_of(weighed: Weighed, other: Calibration) -> Calibration:
    """The calibration of another sensor, with the change of the light that this one shows at rest."""
    if other.force is None:
        return other
    force = other.force.model_copy(update={"change_at_rest": weighed.watched.change_at_rest})
    return other.model_copy(update={"force": force})


def carry(calibration: Calibration, other: Calibration, found: Gain) -> Calibration:
    """A calibration with the force part of another sensor of its kind, times the gain.

    other : with the change at rest of this sensor, see `at_rest_of`. found : of it on this sensor; its error
    is added.

    Raises ConfigError for fewer than `FEWEST_LOADS_TO_CARRY`.
    """
    if len(found.known) < FEWEST_LOADS_TO_CARRY:
        raise ConfigError(
            f"calibrate force --like: required {FEWEST_LOADS_TO_CARRY} loads or more, "
            f"found {len(found.known)}"
        )
    assert other.force is not None
    entry, factor, doubt = other.force, found.value, found.stderr / found.value
    press, drag = (
        None
        if part is None
        else part.model_copy(
            update={
                "stiffness": {name: factor * value for name, value in part.stiffness.items()},
                **_scaled(part.error, part.range, part.rmse, factor, doubt),
            }
        )
        for part in (entry.press, entry.drag)
    )
    dots = {
        axis: part.model_copy(update=_scaled(part.error, part.range, part.rmse, factor, doubt))
        for axis, part in entry.dots.items()
    }
    force = entry.model_copy(update={"press": press, "drag": drag, "dots": dots, "drift": 0.0})
    field = other.field_force
    scaled = None if field is None else FieldForce(field.modes, factor * field.weights)
    return calibration.model_copy(update={"force": force, "field_force": scaled})


def _scaled(
    error: tuple[float, float], limits: tuple[float, float], rmse: float, factor: float, doubt: float
) -> dict[str, object]:
    """Errors of a force times a factor with a relative standard error."""
    return {
        "error": (factor * error[0], math.hypot(error[1], doubt)),
        "range": (factor * limits[0], factor * limits[1]),
        "rmse": factor * rmse,
    }
