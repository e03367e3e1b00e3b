"""Stage `hold`: extends another signal in time."""

from __future__ import annotations

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.ports import Held


class Hold(Stage):
    """Keeps a signal true for some frames after its end, and makes it true at regular intervals.

    For gates, which have no memory: `when: held`. A stage closed by this gate reports the reason of the
    extended signal (`no_contact` for `touching`). Frames without the signal are not counted.

    >>> hold = Hold(Hold.Params(hold=1))
    >>> [hold.process(signal) for signal in (False, True, False, False)]
    [False, True, True, False]
    """

    memory = "stateful"

    class Params(StageParams):
        """Duration, and minimum frequency."""

        hold: int = Field(0, ge=0, description="frames for which it stays true after the signal fell")
        at_least_every: int | None = Field(
            None, ge=1, description="maximum number of frames until it is true for one frame; null: no limit"
        )

    def __init__(self, params: Params) -> None:
        """Start as if the signal had never been true."""
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget when the signal was true."""
        self._left = 0
        self._closed = 0

    def process(self, signal: bool) -> Held:
        """Whether the signal is true, was true recently, or a frame is due."""
        held = bool(signal) or self._left > 0
        self._left = self.params.hold if signal else max(0, self._left - 1)
        every = self.params.at_least_every
        due = every is not None and self._closed + 1 >= every
        self._closed = 0 if held or due else self._closed + 1
        return held or due
