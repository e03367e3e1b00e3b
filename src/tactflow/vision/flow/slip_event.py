"""Slip as an event: a sequential test of the evidence of single frames."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from tactflow.vision.types import SlipKind

MAX_FRAME_LOG_ODDS: Final = 3.0
"""Largest evidence of a frame for slip, log-odds: in one frame in twenty, something happens that the model of
the gel does not foresee."""
AGAINST_RATIO: Final = 0.5
"""Largest evidence of a frame against slip, relative to that for it: an object that sticks and slips in turn
pauses."""
REST_LOG_ODDS: Final = -1.25 * MAX_FRAME_LOG_ODDS
"""Log-odds of slip of an object that is held: one frame is not enough for a report, two of three are."""
LARGEST_LOG_ODDS: Final = 0.75 * MAX_FRAME_LOG_ODDS
"""Largest log-odds of slip: a report outlasts one frame without evidence, but not two."""


class SlipEvent(NamedTuple):
    """State of the test.

    probability : that the object slips. kind : how; None while it does not. onset : time of the first frame
    with evidence of the present slip, s; None while there is none.
    """

    probability: float
    kind: SlipKind | None
    onset: float | None

    @property
    def slipping(self) -> bool:
        """Whether slip is reported."""
        return self.kind is not None


class EventTest:
    """Adds up the evidence of frames for slip: a sequential probability ratio test between two bounds.

    A report needs two of three frames with clear evidence, and ends after two without. So the noise of one
    frame never causes a report.

    References
    ----------
    E. S. Page, "Continuous inspection schemes", Biometrika 1954.

    Examples
    --------
    >>> test = EventTest()
    >>> shares = (0, 1, 0, 0, 1, 1, 0, 1, 0, 0)
    >>> [int(test(seq / 60, share, "sliding").slipping) for seq, share in enumerate(shares)]
    [0, 0, 0, 0, 0, 1, 1, 1, 1, 0]
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The object is held: what was seen before is explained otherwise."""
        self._log_odds = REST_LOG_ODDS
        self._kind: SlipKind | None = None
        self._onset: float | None = None

    def __call__(self, time: float, probability: float, kind: SlipKind) -> SlipEvent:
        """The state after one more frame.

        time : of the frame, s. probability : of slip, from this frame alone, 0 to 1. kind : of that slip.
        """
        odds = math.log(max(probability, 1e-9) / max(1 - probability, 1e-9))
        odds = min(max(odds, -AGAINST_RATIO * MAX_FRAME_LOG_ODDS), MAX_FRAME_LOG_ODDS)
        self._log_odds = min(max(self._log_odds + odds, REST_LOG_ODDS), LARGEST_LOG_ODDS)
        if self._log_odds == REST_LOG_ODDS:
            self._onset = None
        elif self._onset is None:
            self._onset = time
        if self._kind is None or odds > 0:
            self._kind = kind
        if self._log_odds <= 0:
            self._kind = None
        share = 1 / (1 + math.exp(-self._log_odds))
        return SlipEvent(share, self._kind, None if self._kind is None else self._onset)
