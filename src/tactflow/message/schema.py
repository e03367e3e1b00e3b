"""The JSON Schema of the result message `tactflow.frame/1`, which `encoding.py` writes."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.json_schema import GenerateJsonSchema

from tactflow.message.encoding import SCHEMA
from tactflow.vision.types import Evidence

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Point = tuple[_Finite, _Finite]
_Vector = tuple[_Finite, _Finite, _Finite]
_Angle = Annotated[float, Field(gt=-90, le=90, allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Share = Annotated[float, Field(ge=0, le=1)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _EllipseModel(_Strict):
    """Ellipse fitted to the contact."""

    center: _Point = Field(description="(x, y), px")
    axes: tuple[_Positive, _Positive] = Field(description="full lengths (major, minor), px")
    angle: _Angle | None = Field(description="of the major axis, degrees; null for a circle")


class _ContactModel(_Strict):
    """Geometry of the contact region."""

    area: float = Field(ge=0, description="of the convex hull, px^2")
    center: _Point = Field(description="centroid of the contact region, px")
    angle: _Angle | None = Field(
        description="principal axis, degrees, counter-clockwise as seen; null where there is no direction"
    )
    slope: _Finite | None = Field(
        description="dy/dx of that axis, y down; null where it is vertical or there is no direction"
    )
    hull: list[_Point] = Field(description="vertices of the convex hull in order, px")
    ellipse: _EllipseModel | None = Field(description="null where none can be fitted")
    evidence: Evidence = Field(
        description="what shows it: a change of the light, motion of the markers (dots), or both"
    )
    probability: float | None = Field(
        None, ge=0, le=1, description="of being a contact; below 0.5 it is unsure (absent if not known)"
    )
    confidence: float = Field(
        0.0, ge=0, le=1, description="of the direction: 0 a disc, towards 1 a line (detail)"
    )
    center_mm: _Point | None = Field(None, description="center from the scale's origin, mm (calibrated)")
    center_mm_stderr: _Point | None = Field(
        None, description="what the scale's error does to center_mm, mm (calibrated, detail)"
    )
    area_mm2: _NotNegative | None = Field(None, description="area, mm^2 (calibrated)")
    area_mm2_stderr: _NotNegative | None = Field(
        None, description="what the scale's error does to area_mm2, mm^2 (calibrated, detail)"
    )
    normal: tuple[_Finite, _Finite, _Finite] | None = Field(
        None,
        description="mean unit normal of the gel's surface in the contact, out of the gel: x right, y down "
        "(calibrated, only with the stage normals)",
    )
    depth_mm: _NotNegative | None = Field(
        None, description="how far the surface has been pushed in where it is deepest, mm (calibrated)"
    )
    depth_mm_stderr: _NotNegative | None = Field(
        None, description="standard error of depth_mm, mm; null when unknown (calibrated, detail)"
    )
    volume_mm3: _NotNegative | None = Field(
        None, description="between the untouched surface and the pressed one, mm^3 (calibrated)"
    )
    volume_mm3_stderr: _NotNegative | None = Field(
        None, description="standard error of volume_mm3, mm^3; null when unknown (calibrated, detail)"
    )


class _FlowModel(_Strict):
    """How the gel inside the contact has moved."""

    mean: _Point | None = Field(description="mean displacement (dx, dy), px; null when not known")
    count: int = Field(ge=0, description="number of markers inside the contact")
    mean_mm: _Point | None = Field(None, description="mean, mm; null when not known (calibrated)")
    mean_mm_stderr: _Point | None = Field(
        None, description="standard error of mean_mm, mm (calibrated, detail)"
    )
    stderr: _Point | None = Field(None, description="standard error of mean, px; null when unknown (detail)")
    rotation: _Finite | None = Field(
        None, description="twist, degrees, counter-clockwise as seen; null when unknown (detail)"
    )
    divergence: _Finite | None = Field(
        None, description="relative growth in area of the gel; null when unknown (detail)"
    )
    residual: _Finite | None = Field(
        None,
        description="RMS of what mean, rotation, divergence leave, px; null when unknown (detail)",
    )
    shear: _Point | None = Field(
        None,
        description="(du/dx - dv/dy, du/dy + dv/dx) of the displacement (u, v); null when unknown (detail)",
    )
    rotation_stderr: _Positive | None = Field(None, description="degrees; null when unknown (detail)")
    divergence_stderr: _Positive | None = Field(None, description="null when unknown (detail)")
    shear_stderr: _Positive | None = Field(None, description="of each part; null when unknown (detail)")


class _MarkersModel(_Strict):
    """The markers; index i is the same physical marker for the whole run. Ones found later come last."""

    origin: list[_Point] = Field(description="positions in the reference frame, px")
    position: list[_Point] = Field(
        description="positions now, px; repeated while none can have moved by more than 0.05"
    )
    status: list[Literal["tracked", "inferred", "lost"]] = Field(description="how each position is known")
    stderr: list[_NotNegative | None] = Field(
        default_factory=list, description="standard error of each position, px; null when unknown (detail)"
    )
    probability: list[_Share | None] = Field(
        default_factory=list,
        description="of each being a marker at all, by its looks and motion; null when unknown (detail)",
    )


class _SlipModel(_Strict):
    """How the object moves against the gel."""

    slipping: bool = Field(description="whether it slides over the gel")
    stick_ratio: float = Field(
        ge=0, le=1, description="share of the contact on which the gel moves with it; 0 while it slides"
    )
    probability: _Share | None = Field(None, description="that it slides; null when unknown")
    translation: _Point | None = Field(
        None, description="(x, y), how far the middle of the contact has moved over the gel, px"
    )
    rotation: _Finite | None = Field(
        None, description="how far it has turned on the gel, degrees, counter-clockwise as seen"
    )
    speed: _NotNegative | None = Field(
        None, description="RMS over the contact, px/s; null in the first frame"
    )
    since: int | None = Field(
        None, ge=0, description="seq of the frame from which translation and rotation are measured"
    )
    translation_mm: _Point | None = Field(None, description="translation, mm (calibrated)")
    speed_mm: _NotNegative | None = Field(None, description="speed, mm/s (calibrated)")
    translation_stderr: tuple[_NotNegative, _NotNegative] | None = Field(
        None, description="standard error of translation, px (detail)"
    )
    rotation_stderr: _NotNegative | None = Field(
        None, description="standard error of rotation, degrees (detail)"
    )
    speed_stderr: _NotNegative | None = Field(None, description="standard error of speed, px/s (detail)")


class _ScaleModel(_Strict):
    """Millimetres of pixels: mm = mm_per_px * (px - origin) along each axis."""

    mm_per_px: tuple[_Positive, _Positive] = Field(description="along (x, y), mm per px")
    origin: _Point = Field(description="(x, y) where the mm coordinates are 0, px")


class _ForceModel(_Strict):
    """The force on the gel."""

    value: tuple[_Finite | None, _Finite | None, _NotNegative] = Field(
        description="(x, y, z), N: z presses on the gel, x and y drag it along the axes of the picture; null "
        "when not known"
    )
    stderr: tuple[_NotNegative | None, _NotNegative | None, _NotNegative | None] = Field(
        description="standard errors, N; null where value is, and where a network gives the force"
    )
    in_range: bool = Field(
        description="whether the calibration was fitted to such contacts; stderr only holds there"
    )


class _PoseModel(_Strict):
    """How what touches the gel has moved since it was touched."""

    status: Literal["tracked", "lost"] = Field(
        description="lost: what touches now cannot be matched; the values are those of the frame before, and "
        "the next frame is a new start"
    )
    since: int = Field(ge=0, description="seq of the frame in which it was touched, or tracked anew")
    center: _Vector = Field(
        description="(x, y, z), middle of the contact then, mm: x right, y down, z out of the gel"
    )
    translation: _Vector = Field(description="(x, y, z) of this point of the object since then, mm")
    rotation: _Vector = Field(description="rotation vector of the object about this point, degrees")
    stderr: tuple[_NotNegative, _NotNegative, _NotNegative, _NotNegative, _NotNegative, _NotNegative] = Field(
        description="standard errors of translation, mm, and rotation, degrees"
    )
    covariance: list[_Finite] = Field(
        default_factory=list, description="of these six, (6, 6) row by row, mm and degrees (detail)"
    )


class _FeaturesModel(_Strict):
    """Output of a network of the user."""

    values: list[_Finite] = Field(description="as many numbers as the network gives")
    unit: str = Field(description="of the numbers")


class _FieldModel(_Strict):
    """Displacement of the gel on a regular grid."""

    first: _Point = Field(description="(x, y) of row 0, column 0, in the reference frame, px")
    spacing: _Positive = Field(description="from one point to the next along both axes, px")
    displacement: list[list[_Point]] = Field(description="rows of (dx, dy), px")
    stderr: list[list[_NotNegative]] = Field(description="standard error of each component, rows, px")


class _Message(_Strict):
    """The results of one processed frame."""

    model_config = ConfigDict(title=SCHEMA)

    schema_: Literal["tactflow.frame/1"] = Field(alias="schema")
    sensor: str = Field(description="name of the sensor")
    seq: int = Field(ge=0, description="index of the frame at the source; a dropped frame leaves a gap")
    t: _Finite = Field(description="capture time, s: from the start of a recording, or Unix time if live")
    size: tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]] = Field(
        description="(width, height) of the processed frame, px"
    )
    contact: _ContactModel | None = Field(description="null when nothing touches the gel")
    contacts: list[_ContactModel] = Field(
        description="every separate contact, that with the most pixels first; empty when nothing touches"
    )
    flow: _FlowModel | None = Field(description="null when there is no contact")
    markers: _MarkersModel | None = Field(description="null when markers were not computed")
    field: _FieldModel | None = Field(
        None, description="displacement field; null without contact (only where the sink's field is true)"
    )
    slip: _SlipModel | None = Field(
        None, description="of the contact (only where the pipeline has the stage slip)"
    )
    scale: _ScaleModel | None = Field(None, description="makes mm of px (calibrated)")
    force: _ForceModel | None = Field(
        None, description="on the gel; only where something touches (calibrated)"
    )
    pose: _PoseModel | None = Field(
        None, description="of the object (only where the pipeline has the stage pose; calibrated)"
    )
    features: _FeaturesModel | None = Field(
        None, description="of a network (only where a stage network gives features)"
    )
    skipped: dict[str, str] = Field(
        description="port -> why this frame did not need it: unchanged and at_rest repeat the last value, by "
        "which a contact begins and ends at most one frame late; reference -> why this frame became a new one"
    )


class _NoDefaults(GenerateJsonSchema):
    """Without defaults, because a field missing in a message has no value."""

    def default_schema(self, schema: Any) -> dict[str, Any]:
        return self.generate_inner(schema["schema"])


@functools.cache
def message_schema() -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of the result message; cached, do not modify it.

    `field` and the fields marked (detail) or (calibrated) are optional.
    """
    schema = _Message.model_json_schema(by_alias=True, schema_generator=_NoDefaults)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def resolved(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """A part of a JSON Schema with `$ref` and `anyOf` resolved, assuming that it is not null."""
    inner = next((choice for choice in part.get("anyOf", ()) if choice.get("type") != "null"), part)
    if "$ref" in inner:
        inner = definitions[inner["$ref"].rpartition("/")[2]]
    return {key: value for key, value in {**inner, **part}.items() if key not in ("$ref", "anyOf")}
