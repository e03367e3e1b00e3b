"""Has anything changed? A cheap look at a raw frame.

A few lines of the frame are read, spread evenly, and compared with those of the *anchor*, the last frame
that was worked on: where the sum of squared differences exceeds what noise makes, the frame has changed and
nothing else is looked at. If it does not, the same is done with four times as many lines, and then sums over
tiles are tested:

- light: the sums of each channel and of all, which show a light that changes little but over an area;
- motion: the projection on the gel's gradients at its steepest edges, which is the least-squares estimate of
  a displacement (Lucas and Kanade, 1981);
- marks: the sum over those edges, which shows a dot that went further than its own size.

Each is tested in every tile and in windows of tiles (a contact shades and drags its surroundings along, and
together they show what none of them shows alone), in units of the noise that such sums have on this sensor.
That noise is learned from frames in a row, tile by tile. It is what neighbouring tiles do not share: light
that flickers is never taken for noise. All tests have one bound, set from the share of still frames that may
be taken for changed (Bonferroni over all tests).

Comparing with the anchor, not with the frame before, means that a slow drift adds up until it is seen.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from tactflow.vision.change.noise import QUANTISATION, WARM_UP, NoiseModel
from tactflow.vision.change.tiles import Sample, Tiling

_MEAN = 4
"""Unchanged frames since the last change, the first ones, over which the anchor's sums are averaged, at most.
Chosen by hand."""
_CALM = 0.1
"""Fraction of still frames that are not calm, 1. Chosen by hand."""
_EVERY = 16
"""The noise is learned once in so many frames: it changes slowly, and learning costs as much as a look.
Chosen by hand."""


class ChangeProbe:
    """Tells whether a frame differs from the anchor by more than noise.

    Computed in float32; the test values are those of float64 to 1e-5 of themselves.

    frame : (H, W, C) or (H, W) uint8, the first frame; it fixes the size and where to look.
    false_alarms : share of still frames that are called changed all the same, in (0, 0.5]. Each costs one
        frame's work; a smaller share lets larger changes pass unseen.
    tile : edge of a tile, px >= 8. Smaller tiles see smaller contacts and cost more.

    Raises ValueError if a frame is not an image of uint8, if its size differs from the first one's, or for a
    parameter out of range.

    >>> still = np.full((48, 64, 3), 100, np.uint8)
    >>> probe = ChangeProbe(still)
    >>> [probe.look(still) for _ in range(8)]
    [True, True, True, True, True, True, False, False]
    >>> probe.look(still + np.uint8(9))
    True
    """

    def __init__(self, frame: NDArray[np.uint8], *, false_alarms: float = 1e-3, tile: int = 40) -> None:
        if not 0 < false_alarms <= 0.5:
            raise ValueError(f"required false_alarms in (0, 0.5], got {false_alarms}")
        if not (tile >= 8 and math.isfinite(tile)):
            raise ValueError(f"required a tile of at least 8 px, got {tile}")
        self._shape = _checked(frame).shape
        self._tiling = tiling = Tiling(frame, tile)
        noise = self._noise = NoiseModel(tiling)
        self.bound, self._calm = (
            -NormalDist().inv_cdf(fraction / (2 * (noise.tests + 2)))
            for fraction in (false_alarms, max(false_alarms, _CALM))
        )
        """What the strongest test value must exceed, in standard deviations."""
        self.strongest = float("inf")
        """The strongest test value of the last look, in standard deviations of noise; at least that, where
        it is above the bound: what has changed for sure is not tested further."""
        self._anchor: Sample | None = None
        self._last: Sample | None = None
        # Mean of the sums over the first unchanged frames, and of how many; the same of the anchor.
        self._mean: NDArray[np.float32] | None = None
        self._anchor_mean: NDArray[np.float32] | None = None
        self._frames = self._anchor_frames = 0
        # The anchor, the last frame and this one.
        self._spare = [Sample(tiling) for _ in range(3)]
        self._looks = 0

    @property
    def noise(self) -> float | None:
        """Standard deviation of a pixel's noise, grey levels, over the frame; None before it is known."""
        if self._noise.pairs == 0:
            return None
        return math.sqrt(max(self._noise.ssd.mean / (2 * self._tiling.count), QUANTISATION))

    @property
    def ready(self) -> bool:
        """Whether the noise is known, so that a look can tell what is unchanged."""
        return self._noise.pairs >= WARM_UP

    @property
    def calm(self) -> bool:
        """Whether the last look saw nothing that nine of ten still frames do not show as well.

        A change that is too small to be told from noise for sure mostly is not calm either.
        """
        return self.strongest <= self._calm

    def look(self, frame: NDArray[np.uint8]) -> bool:
        """Compare a frame with the anchor; one that has changed becomes the anchor.

        frame : same shape and dtype as the first. It is kept while it is the anchor or the last one, and must
            not be written to meanwhile.
        Returns True if the frame differs from the anchor by more than noise, or while the noise is not known
        yet.
        """
        if _checked(frame).shape != self._shape:
            raise ValueError(f"required a frame of shape {self._shape}, got {frame.shape}")
        now, last = self._spare.pop(), self._last
        now.take(frame)
        noise = self._noise
        warming_up = not self.ready
        if last is not None and warming_up:
            noise.learn(now, last, self.bound)
        if self._anchor is None or not self.ready:
            self.strongest = float("inf")
        else:
            self.strongest = self._compare(now, self._anchor)
        changed = self.strongest > self.bound
        self._follow(now, changed)
        self._looks += 1
        if last is not None:
            if not warming_up and self._looks % _EVERY == 0:
                noise.learn(now, last, self.bound)
            if last is not self._anchor:
                self._spare.append(last)
        self._last = now
        if changed:
            self.anchor_here()
        return changed

    def anchor_here(self) -> None:
        """Make the frame of the last look the anchor: it is worked on, whatever the look said."""
        if self._anchor is not None and self._anchor is not self._last:
            self._spare.append(self._anchor)
        self._anchor = self._last
        self._anchor_mean, self._anchor_frames = self._mean, self._frames

    def _follow(self, now: Sample, changed: bool) -> None:
        """Take a frame into the mean of the first ones that are unchanged."""
        if changed:
            self._mean, self._frames = None, 0
        elif self._frames < _MEAN:
            self._frames += 1
            sums = now.sums()
            mean = sums if self._mean is None else self._mean
            self._mean = mean + (sums - mean) / np.float32(self._frames)

    def _compare(self, now: Sample, then: Sample) -> float:
        """The largest of the tests' values, each a standard normal deviate under noise alone."""
        noise = self._noise
        strongest = noise.coarse_ssd.excess(now.coarse_ssd(then))
        if strongest <= self.bound:
            strongest = max(strongest, noise.ssd.excess(now.ssd(then)))
        if strongest > self.bound:
            return strongest
        mean, frames = self._anchor_mean, self._anchor_frames
        if mean is None:
            mean, frames = then.sums(), 1
        # Scaled for the noise of two frames; that of a mean is less.
        return max(strongest, noise.strongest(now.sums() - mean) * math.sqrt(2 / (1 + 1 / frames)))


def _checked(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if frame.dtype != np.uint8 or frame.ndim not in (2, 3) or frame.size == 0:
        raise ValueError(f"required an image of uint8, got shape {frame.shape} {frame.dtype}")
    return frame
