"""Parameters that several stages share."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tactflow.engine.contract import StageParams


class LightParams(StageParams):
    """How much the light on the untouched gel varies; `gel` of a pipeline file sets it for all stages.

    >>> LightParams()
    LightParams(repeatability=0.025)
    """

    repeatability: float = Field(
        0.025, ge=0, le=1, description="variation of the light on the untouched gel, relative; see gel"
    )


class GelParams(LightParams):
    """How much its light and its colour vary.

    >>> GelParams(tint=0.02)
    GelParams(repeatability=0.025, tint=0.02)
    """

    tint: float = Field(
        0.01,
        ge=0,
        le=1,
        description="variation of the colour of that light, relative to its brightness; see gel",
    )


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
