"""Temporal smoothing of the contact's centre and direction."""

from __future__ import annotations

import dataclasses
import math

from tactflow.vision.geometry.direction import VERTICAL
from tactflow.vision.types import Contact


class OneEuro:
    """The One Euro filter (Casiez, Roussel and Vogel, CHI 2012).

    A first-order low-pass whose cut-off rises with speed: steady when still, prompt when moving.

    min_cutoff : Hz, > 0, the cut-off at rest; lower is steadier and slower.
    speed_coefficient : >= 0, Hz of cut-off per unit of speed (the paper's beta); higher lags less in motion.
    speed_cutoff : Hz, > 0, of the low-pass on the speed itself.
    period : of a value that wraps round, in its unit (180 for the angle of an axis); 0 for one that does not.
        Differences are then the shortest way round, so nothing happens at the seam, and results lie in
        (-period / 2, period / 2].

    >>> smooth = OneEuro(min_cutoff=1.0)
    >>> [round(smooth.update(value, dt=0.1), 3) for value in (0.0, 1.0, 1.0)]
    [0.0, 0.404, 0.64]
    """

    def __init__(
        self,
        min_cutoff: float = 1.0,
        speed_coefficient: float = 0.02,
        speed_cutoff: float = 1.0,
        period: float = 0.0,
    ) -> None:
        _require("min_cutoff", min_cutoff, "> 0 Hz", min_cutoff > 0)
        _require("speed_coefficient", speed_coefficient, ">= 0", speed_coefficient >= 0)
        _require("speed_cutoff", speed_cutoff, "> 0 Hz", speed_cutoff > 0)
        _require("period", period, ">= 0", period >= 0)
        self._min_cutoff = min_cutoff
        self._coefficient = speed_coefficient
        self._speed_cutoff = speed_cutoff
        self._period = period
        self._value: float | None = None
        self._last = 0.0
        self._speed = 0.0

    def update(self, value: float, dt: float) -> float:
        """The smoothed value, after the next one, dt seconds (> 0) after the last.

        The first value is returned as it is, whatever dt.
        """
        if self._value is None:
            self._value = self._last = value
            return value
        speed = _wrap(value - self._last, self._period) / dt
        self._last = value
        self._speed += _weight(self._speed_cutoff, dt) * (speed - self._speed)
        cutoff = self._min_cutoff + self._coefficient * abs(self._speed)
        step = _weight(cutoff, dt) * _wrap(value - self._value, self._period)
        self._value = _wrap(self._value + step, self._period)
        return self._value


class ContactSmoother:
    """Smooths the centre and the angle of a contact from frame to frame, each with a `OneEuro` filter.

    min_cutoff, speed_coefficient : of `OneEuro`.

    The angle is that of an axis: it is filtered with period 180 degrees, so +89 and -89 are 2 degrees apart.
    The first contact after none starts afresh, and so does the angle after a frame without direction.

    >>> import numpy as np
    >>> smoother = ContactSmoother()
    >>> for t, angle in enumerate((80.0, -80.0)):
    ...     contact = Contact(9.0, (5.0, 5.0), angle, None, np.zeros((3, 2)), None)
    ...     smoothed = smoother.update(contact, t / 60)
    >>> round(smoothed.angle)
    85
    """

    def __init__(self, min_cutoff: float = 1.0, speed_coefficient: float = 0.02) -> None:
        self._options = min_cutoff, speed_coefficient
        self.reset()

    def reset(self) -> None:
        """Forget the past: contact has ended."""
        self._t: float | None = None
        self._center = OneEuro(*self._options), OneEuro(*self._options)
        self._angle: OneEuro | None = None

    def update(self, contact: Contact, t: float) -> Contact:
        """The contact with smoothed center, angle and slope; the rest is left as measured.

        t : capture time, s. Where it does not advance (a recording that starts again), the past is forgotten.
        """
        if self._t is not None and t <= self._t:
            self.reset()
        dt = t - self._t if self._t is not None else 0.0
        self._t = t
        x, y = (axis.update(value, dt) for axis, value in zip(self._center, contact.center, strict=True))
        if contact.angle is None:
            self._angle = None
            return dataclasses.replace(contact, center=(x, y))
        if self._angle is None:
            self._angle = OneEuro(*self._options, period=180.0)
        angle = self._angle.update(contact.angle, dt)
        slope = None if abs(angle) > 90 - VERTICAL else -math.tan(math.radians(angle)) + 0.0
        return dataclasses.replace(contact, center=(x, y), angle=angle, slope=slope)


def _weight(cutoff: float, dt: float) -> float:
    """Weight of the new value in a first-order low-pass of this cut-off, Hz."""
    turn = 2 * math.pi * cutoff * dt
    return turn / (turn + 1)


def _wrap(value: float, period: float) -> float:
    """The same place in (-period / 2, period / 2]."""
    if period == 0.0:
        return value
    return value - period * math.ceil(value / period - 0.5)


def _require(name: str, value: float, rule: str, kept: bool) -> None:
    if not (kept and math.isfinite(value)):
        raise ValueError(f"required {name} {rule}, got {value}")
