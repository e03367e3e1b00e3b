"""Stages and sinks with every kind of port and parameter, for tests of pipeline files.

Copied beside each test's pipeline file and named there as ./parts.py:Class.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tactflow.engine import contract
from tactflow.engine.contract import Sink, Stage, StageParams
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.ports import ContactMask, Image, Touching
from tactflow.vision.types import Contact, Flow

ZERO = np.zeros((0, 2))


class Source(contract.Source):
    class Params(StageParams):
        source: str | int = Field("sim:press", description="where frames come from")
        realtime: bool = Field(False, description="at its own pace")

    def frames(self) -> Iterator[Frame]:
        yield from ()


class Lens(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    focal: float = Field(gt=0, description="focal length, px")
    fisheye: bool = Field(False, description="wide angle")


class Prepare(Stage):
    memory = "pure"

    class Params(StageParams):
        rotate: Literal[0, 90, 180, 270] = Field(0, description="degrees")
        gamma: float = Field(1.0, gt=0, le=5, description="1 is linear")
        corners: list[tuple[float, float]] = Field([], max_length=4, description="px")
        size: tuple[int, int] | None = Field(None, description="px")
        lens: Lens | None = Field(None, description="undistortion")
        method: Literal["area", "pyramid"] = Field("area", description="of downsampling")

        @model_validator(mode="after")
        def _size_needs_corners(self) -> Prepare.Params:
            if self.size is not None and not self.corners:
                raise ValueError("size needs corners")
            return self

    def process(self, frame: Frame) -> Image:
        return frame.image


class Invert(Stage):
    memory = "pure"

    def process(self, image: Image) -> Image:
        return 255 - image


class Masks(NamedTuple):
    contact_mask: ContactMask
    touching: Touching


class Compare(Stage):
    memory = "stateful"

    class Params(StageParams):
        threshold: int = Field(14, ge=0, le=255, description="grey levels")

    def process(self, image: Image, frame: Frame) -> Masks | Absent:
        return Masks(image[:, :, 0], frame.seq > 0)


class Outline(Stage):
    memory = "pure"

    class Params(StageParams):
        min_area: int = Field(5, ge=0, description="px^2")
        name: str = Field("", max_length=8, description="of the shape")

    def process(self, contact_mask: ContactMask) -> Contact | Absent:
        return (
            Absent("no_contact")
            if not contact_mask.any()
            else Contact(1.0, (0.0, 0.0), None, None, ZERO, None)
        )


class Refine(Stage):
    memory = "pure"

    def process(self, contact: Contact, flow: Flow | None) -> Contact:
        return contact if flow is None else Contact(float(flow.count), contact.center, None, None, ZERO, None)


class Needy(Stage):
    memory = "pure"

    class Params(StageParams):
        path: str = Field(description="required")

    def process(self, image: Image) -> Flow:
        return Flow(None, int(image[0, 0, 0]))


class Publish(Sink):
    class Params(StageParams):
        path: str = Field("out", description="file")

    def write(self, tick: Tick, image: Image | None, contact: Contact | None) -> None:
        pass


class Require(Sink):
    def write(self, contact: Contact) -> None:
        pass


class Viewer(Sink):
    observer = True

    def write(self, image: Image | None) -> None:
        pass


class Bare(Stage):
    memory = "pure"

    def process(self, image) -> Contact:  # type: ignore[no-untyped-def]
        raise NotImplementedError
