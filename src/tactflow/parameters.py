"""Parameters that several stages share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.contract import StageParams


class MarkParams(StageParams):
    """What the printed marks look like.

    >>> MarkParams(polarity="bright")
    MarkParams(dot=None, polarity='bright')
    """

    dot: float | None = Field(
        None, ge=1, le=200, description="radius of a mark, processed px; null finds it in the first frame"
    )
    polarity: Literal["auto", "dark", "bright"] = Field(
        "auto", description="marks against the gel; auto takes the better lattice"
    )
