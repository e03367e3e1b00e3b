"""Probe: has anything changed since the last frame that was worked on?"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import Changed
from tactflow.vision.change import ChangeProbe

_SETTLING = 3
"""The last held frames, which are looked at; those before are worked on anyway, whatever a look would say."""


class ProbePorts(NamedTuple):
    """What the probe tells."""

    changed: Changed


class Probe(Stage):
    """Looks at samples of the raw frame, so that stages with `when: changed` repeat their results."""

    memory = "stateful"

    class Params(StageParams):
        """How careful to be."""

        false_alarms: float = Field(
            1e-3,
            gt=0,
            le=0.5,
            description="share of still frames that are worked on all the same; a smaller share lets larger "
            "changes pass unseen",
        )
        tile: int = Field(
            40, ge=8, description="edge of the tiles that are tested on their own, px of the raw frame"
        )
        hold: int = Field(
            5,
            ge=0,
            description="frames for which a change keeps the stages at work; the last of them are compared "
            "with the one that changed, so that what moves too slowly for one frame adds up",
        )
        at_least_every: int = Field(
            30, ge=1, description="frames after which a still scene is worked on anyway; 1: always"
        )

    def __init__(self, params: Params, skipping: bool = True) -> None:
        """Prepare; the first frame says where to look. Where nothing is skipped, nothing is looked at."""
        self.params = params
        self._skipping = skipping
        self._probe: ChangeProbe | None = None
        self._since = 0
        self._left = 0
        self._span = params.hold
        self._rest = 0

    def reset(self) -> None:
        """A new reference follows: choose the places to look at anew."""
        self._probe = None

    def process(self, frame: Frame) -> ProbePorts:
        """Compare with the last frame that was worked on. A reference frame always is."""
        if not self._skipping:
            return ProbePorts(True)
        if self._probe is None:
            self._probe = ChangeProbe(
                frame.image, false_alarms=self.params.false_alarms, tile=self.params.tile
            )
        probe = self._probe
        if self._left > _SETTLING and probe.ready:
            self._left -= 1
            return ProbePorts(True)
        changed = probe.look(frame.image)
        self._since += 1
        if changed or (self._left == 1 and not probe.calm):
            # Rest begins with a calm frame only: what is in doubt is taken for a change.
            self._span = self._held_for(probe.strongest <= 2 * probe.bound)
            self._left, self._rest = self._span, 0
            probe.anchor_here()
        elif self._left > 0:
            self._left -= 1
            if self._left == 0:
                probe.anchor_here()
        elif frame.reference or self._since >= self.params.at_least_every:
            probe.anchor_here()
        else:
            self._rest += 1
            return ProbePorts(False)
        self._since = 0
        return ProbePorts(True)

    def _held_for(self, faint: bool) -> int:
        """For how many frames a change is held.

        One that is faint and ends a short rest is a slow motion: it is held for twice as long as the last
        one, to see more of it.
        """
        hold: int = self.params.hold
        if not faint or self._rest >= 2 * self._span:
            return hold
        return self._span if self._rest == 0 else min(2 * self._span, max(hold, self.params.at_least_every))
