"""Temporal smoothing of the contact's centre and direction."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Literal

from tactflow.vision.geometry.direction import VERTICAL
from tactflow.vision.types import Contact

Method = Literal["one_euro", "alpha_beta"]


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


class AlphaBeta:
    """The alpha-beta filter: a constant-velocity Kalman filter in its steady state.

    alpha : (0, 1], fraction of the innovation that corrects the value; lower is steadier and slower.
    beta : [0, 2), fraction of it that corrects the velocity; None takes alpha^2 / (2 - alpha), the choice
        with least variance and overshoot together (Benedict and Bordner, 1962).
    period : as for `OneEuro`.

    >>> smooth = AlphaBeta(alpha=0.5)
    >>> [round(smooth.update(value, dt=0.1), 3) for value in (0.0, 1.0, 1.0)]
    [0.0, 0.5, 0.833]
    """

    def __init__(self, alpha: float = 0.5, beta: float | None = None, period: float = 0.0) -> None:
        _require("alpha", alpha, "in (0, 1]", 0 < alpha <= 1)
        if beta is None:
            beta = alpha * alpha / (2 - alpha)
        # Beyond this bound the filter oscillates without end.
        _require("beta", beta, f"in [0, {4 - 2 * alpha:g})", 0 <= beta < 4 - 2 * alpha)
        _require("period", period, ">= 0", period >= 0)
        self._alpha = alpha
        self._beta = beta
        self._period = period
        self._value: float | None = None
        self._velocity = 0.0

    def update(self, value: float, dt: float) -> float:
        """As `OneEuro.update`."""
        if self._value is None:
            self._value = value
            return value
        predicted = self._value + self._velocity * dt
        innovation = _wrap(value - predicted, self._period)
        self._velocity += self._beta * innovation / dt
        self._value = _wrap(predicted + self._alpha * innovation, self._period)
        return self._value


class ContactSmoother:
    """Smooths the centre and the angle of a contact from frame to frame.

    method : "one_euro" adapts to speed and needs no model; "alpha_beta" predicts constant velocity, lags
        less in steady motion and overshoots where it stops.
    min_cutoff, speed_coefficient : of `OneEuro`. alpha, beta : of `AlphaBeta`.

    The angle is that of an axis: it is filtered with period 180 degrees, so +89 and -89 are 2 degrees apart.
    The first contact after none starts afresh, and so does the angle after a frame without direction.

    >>> import numpy as np
    >>> smoother = ContactSmoother("alpha_beta", alpha=0.5)
    >>> for t, angle in enumerate((80.0, -80.0)):
    ...     contact = Contact(9.0, (5.0, 5.0), angle, None, np.zeros((3, 2)), None)
    ...     smoothed = smoother.update(contact, t / 60)
    >>> smoothed.angle
    90.0
    """

    def __init__(
        self,
        method: Method = "one_euro",
        *,
        min_cutoff: float = 1.0,
        speed_coefficient: float = 0.02,
        alpha: float = 0.5,
        beta: float | None = None,
    ) -> None:
        if method not in ("one_euro", "alpha_beta"):
            raise ValueError(f"required method to be 'one_euro' or 'alpha_beta', got {method!r}")
        self._make: Callable[..., OneEuro | AlphaBeta] = (
            partial(OneEuro, min_cutoff, speed_coefficient)
            if method == "one_euro"
            else partial(AlphaBeta, alpha, beta)
        )
        self.reset()

    def reset(self) -> None:
        """Forget the past: contact has ended."""
        self._t: float | None = None
        self._center = (self._make(), self._make())
        self._angle: OneEuro | AlphaBeta | None = None

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
            self._angle = self._make(period=180.0)
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
