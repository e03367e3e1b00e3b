"""Stage `probe`: has anything changed since the last frame that was worked on?"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import Changed
from tactflow.vision.change import ChangeHold, ChangeProbe
from tactflow.vision.geometry.valid_area import bounding_box, valid_area


class ProbePorts(NamedTuple):
    """changed : whether the frame differs from the last one that was worked on."""

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
        super().__init__(params)
        self._skipping = skipping
        self._probe: ChangeProbe | None = None
        self._gel = slice(None), slice(None)
        self._hold = ChangeHold(params.hold, params.at_least_every)

    def reset(self) -> None:
        """A new reference follows: choose the places to look at anew."""
        self._probe = None

    def process(self, frame: Frame) -> ProbePorts:
        """Compare with the last frame that was worked on. A reference frame always is.

        Only the smallest rectangle that holds all of the gel is looked at.
        """
        if not self._skipping:
            return ProbePorts(True)
        if self._probe is None:
            self._gel = bounding_box(valid_area(frame.image))
            self._probe = ChangeProbe(
                frame.image[self._gel], false_alarms=self.params.false_alarms, tile=self.params.tile
            )
        gel = frame.image[self._gel]
        return ProbePorts(self._hold.works_on(gel, self._probe, reference=frame.reference))
