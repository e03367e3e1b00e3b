"""Stage `probe`: which stages does a frame need?"""

from __future__ import annotations

from typing import NamedTuple

from pydantic import Field

from tactflow.engine.contract import Stage
from tactflow.engine.frame import Frame
from tactflow.parameters import GelParams
from tactflow.ports import Changed, Suspect
from tactflow.vision.change import RestTest
from tactflow.vision.geometry.valid_area import bounding_box, valid_area


class ProbePorts(NamedTuple):
    """Which stages a frame needs.

    Attributes
    ----------
    changed : whether anything may have moved.
    suspect : whether the contact may have changed.
    """

    changed: Changed
    suspect: Suspect


class Probe(Stage):
    """Compare samples of the raw frame with those of the frames before.

    With `when: changed`, stages repeat their results while nothing can have changed; with `when: suspect`,
    also while only the dots may have moved.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> probe = tactflow.stage("probe")
    >>> [probe.process(scene.frame(index)).suspect for index in (0, 1, 60)]
    [True, False, True]
    """

    memory = "stateful"
    watches = "touching"

    class Params(GelParams):
        """Sensitivity, and the minimum rate of full frames."""

        false_alarms: float = Field(
            0.01, gt=0, le=0.5, description="share of still frames in which the dots are measured anyway"
        )
        at_least_every: int = Field(
            30, ge=1, description="process every n-th frame even if nothing changed; 1: every frame"
        )

    def __init__(self, params: Params, skipping: bool = True) -> None:
        """Prepare. skipping : if false, every frame is processed."""
        super().__init__(params)
        self._skipping = skipping
        self.reset()

    def reset(self) -> None:
        """A new reference follows."""
        self._test: RestTest | None = None
        self._since_work = 0

    def process(self, frame: Frame) -> ProbePorts:
        """Compare with the frames before. Only the smallest rectangle around the gel is compared;
        a reference frame is always processed."""
        if not self._skipping:
            return ProbePorts(True, True)
        if self._test is None:
            self._test = RestTest(
                frame.image,
                repeatability=self.params.repeatability,
                tint=self.params.tint,
                false_alarms=self.params.false_alarms,
                window=bounding_box(valid_area(frame.image)),
            )
        self._since_work += 1
        due = frame.reference or self._since_work >= self.params.at_least_every
        look = self._test.look(frame.image, touching=self.watched, due=due)
        if look.suspect:
            self._since_work = 0
        return ProbePorts(look.changed, look.suspect)
