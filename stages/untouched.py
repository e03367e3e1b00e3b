"""Stage `untouched`: the picture of the untouched gel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.contract import Stage, StageParams
from tactflow.engine.frame import Frame
from tactflow.ports import Unmarked, Untouched


class UntouchedGel(Stage):
    """Keep the mean of the reference frames, without their markers.

    >>> import tactflow
    >>> tactflow.stage("untouched").process(np.full((60, 80, 3), 128, np.uint8))[0, 0].tolist()
    [128, 128, 128]
    """

    memory = "stateful"

    def __init__(self, params: StageParams) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._sum: NDArray[np.float32] | None = None
        self._count = 0
        self._mean: Untouched | None = None

    def process(self, unmarked: Unmarked, frame: Frame) -> Untouched:
        """The mean of all reference frames so far; without one, the first frame."""
        if self._mean is None or frame.reference:
            picture = unmarked.astype(np.float32)
            self._sum = picture if self._sum is None else self._sum + picture
            self._count += 1
            self._mean = np.rint(self._sum / self._count).astype(np.uint8)
        return self._mean
