"""The JSON Schema of the result message `tactflow.frame/1`, which `encoding.py` writes."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model
from pydantic.json_schema import GenerateJsonSchema

from tactflow.message.encoding import SCHEMA
from tactflow.vision.types import Evidence

Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Vector = tuple[Finite, Finite, Finite]
Angle = Annotated[float, Field(gt=-90, le=90, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Error = NotNegative | None
Errors = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]
Count = Annotated[int, Field(ge=0)]
Pixels = Annotated[int, Field(gt=0)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


def _part(name: str, about: str, **fields: tuple[Any, ...]) -> Any:
    """A part of the message. fields : type, description and, for a field that may be missing, None."""
    attributes: dict[str, Any] = {}
    for key, (kind, text, *default) in fields.items():
        # The underscore, because some keys are attributes of pydantic's models, such as `schema`.
        attributes[f"{key}_"] = (kind, Field(*default, alias=key, title=key, description=text))
    return create_model(name, __base__=_Part, __doc__=about, **attributes)


Ellipse = _part(
    "Ellipse",
    "Ellipse fitted to the contact.",
    center=(Point, "(x, y), px"),
    axes=(tuple[Positive, Positive], "full lengths (major, minor), px"),
    angle=(Angle | None, "of the major axis, degrees; null for a circle"),
)
Contact = _part(
    "Contact",
    "Geometry of the contact region.",
    area=(NotNegative, "of the convex hull, px^2"),
    center=(Point, "centroid of the contact region, px"),
    angle=(Angle | None, "principal axis, degrees, counter-clockwise as seen; null without a direction"),
    slope=(Finite | None, "dy/dx of that axis, y down; null where it is vertical or there is no direction"),
    hull=(list[Point], "vertices of the convex hull in order, px"),
    ellipse=(Ellipse | None, "null where none can be fitted"),
    evidence=(Evidence, "what shows it: a change of the light, motion of the markers (dots), or both"),
    probability=(Share | None, "of being a contact; below 0.5 it is unsure (absent if not known)", None),
    confidence=(Share, "of the direction: 0 a disc, towards 1 a line (detail)", None),
    center_mm=(Point | None, "center from the scale's origin, mm (calibrated)", None),
    center_mm_stderr=(Point | None, "error due to the scale, mm (calibrated, detail)", None),
    area_mm2=(NotNegative | None, "area, mm^2 (calibrated)", None),
    area_mm2_stderr=(NotNegative | None, "error due to the scale, mm^2 (calibrated, detail)", None),
    normal=(
        Vector | None,
        "mean unit normal of the gel's surface, out of the gel: x right, y down (calibrated, only with the "
        "stage normals)",
        None,
    ),
    depth_mm=(NotNegative | None, "greatest indentation of the surface, mm (calibrated)", None),
    depth_mm_stderr=(NotNegative | None, "mm; null when unknown (calibrated, detail)", None),
    volume_mm3=(NotNegative | None, "between untouched and pressed surface, mm^3 (calibrated)", None),
    volume_mm3_stderr=(NotNegative | None, "mm^3; null when unknown (calibrated, detail)", None),
)
Contacts: Any = list[Contact]  # type: ignore[valid-type]
Flow = _part(
    "Flow",
    "How the gel inside the contact has moved.",
    mean=(Point | None, "mean displacement (dx, dy), px; null when not known"),
    count=(Count, "number of markers inside the contact"),
    mean_mm=(Point | None, "mean, mm; null when not known (calibrated)", None),
    mean_mm_stderr=(Point | None, "standard error of mean_mm, mm (calibrated, detail)", None),
    stderr=(Point | None, "standard error of mean, px; null when unknown (detail)", None),
    rotation=(Finite | None, "twist, degrees, counter-clockwise as seen; null when unknown (detail)", None),
    divergence=(Finite | None, "relative growth in area of the gel; null when unknown (detail)", None),
    residual=(Finite | None, "RMS of what these leave unexplained, px; null when unknown (detail)", None),
    shear=(
        Point | None,
        "(du/dx - dv/dy, du/dy + dv/dx), displacement (u, v); null when unknown (detail)",
        None,
    ),
    rotation_stderr=(Positive | None, "degrees; null when unknown (detail)", None),
    divergence_stderr=(Positive | None, "null when unknown (detail)", None),
    shear_stderr=(Positive | None, "of each part; null when unknown (detail)", None),
)
Markers = _part(
    "Markers",
    "The markers; index i is the same physical marker for the whole run. Ones found later come last.",
    origin=(list[Point], "positions in the reference frame, px"),
    position=(list[Point], "positions now, px; repeated while none can have moved by more than 0.05"),
    status=(list[Literal["tracked", "inferred", "lost"]], "how each position is known"),
    stderr=(list[NotNegative | None], "standard error of each, px; null when unknown (detail)", None),
    probability=(list[Share | None], "of each being a marker at all; null when unknown (detail)", None),
)
Slip = _part(
    "Slip",
    "How the object moves against the gel.",
    slipping=(bool, "whether it slides over the gel"),
    stick_ratio=(Share, "share of the contact on which the gel moves with it; 0 while it slides"),
    probability=(Share | None, "that it slides; null when unknown", None),
    translation=(Point | None, "(x, y), how far the middle of the contact has moved over the gel, px", None),
    rotation=(Finite | None, "how far it has turned on the gel, degrees, counter-clockwise as seen", None),
    speed=(NotNegative | None, "RMS over the contact, px/s; null in the first frame", None),
    since=(Count | None, "seq of the frame from which translation and rotation are measured", None),
    translation_mm=(Point | None, "translation, mm (calibrated)", None),
    speed_mm=(NotNegative | None, "speed, mm/s (calibrated)", None),
    translation_stderr=(tuple[NotNegative, NotNegative] | None, "px (detail)", None),
    rotation_stderr=(NotNegative | None, "degrees (detail)", None),
    speed_stderr=(NotNegative | None, "px/s (detail)", None),
)
Scale = _part(
    "Scale",
    "Millimetres of pixels: mm = mm_per_px * (px - origin) along each axis.",
    mm_per_px=(tuple[Positive, Positive], "along (x, y), mm per px"),
    origin=(Point, "(x, y) where the mm coordinates are 0, px"),
)
Force = _part(
    "Force",
    "The force on the gel.",
    value=(
        tuple[Finite | None, Finite | None, NotNegative],
        "(x, y, z), N: z presses on the gel, x and y drag it; null when unknown",
    ),
    stderr=(tuple[Error, Error, Error], "standard errors, N; null when unknown"),
    in_range=(bool, "whether the calibration was fitted to such contacts; stderr only holds there"),
)
Pose = _part(
    "Pose",
    "How what touches the gel has moved since it was touched.",
    status=(Literal["tracked", "lost"], "lost: no match; repeats the frame before, starts anew in the next"),
    since=(Count, "seq of the frame in which it was touched, or tracked anew"),
    center=(Vector, "(x, y, z), middle of the contact then, mm: x right, y down, z out of the gel"),
    translation=(Vector, "(x, y, z) of this point of the object since then, mm"),
    rotation=(Vector, "rotation vector of the object about this point, degrees"),
    stderr=(Errors, "standard errors of translation, mm, and rotation, degrees"),
    covariance=(list[Finite], "of these six, (6, 6) row by row, mm and degrees (detail)", None),
)
Features = _part(
    "Features",
    "Output of a network of the user.",
    values=(list[Finite], "as many numbers as the network gives"),
    unit=(str, "of the numbers"),
)
Grid = _part(
    "Field",
    "Displacement of the gel on a regular grid.",
    first=(Point, "(x, y) of row 0, column 0, in the reference frame, px"),
    spacing=(Positive, "from one point to the next along both axes, px"),
    displacement=(list[list[Point]], "rows of (dx, dy), px"),
    stderr=(list[list[NotNegative]], "standard error of each component, rows, px"),
)
Message = _part(
    SCHEMA,
    "The results of one processed frame.",
    schema=(Literal["tactflow.frame/1"], None),
    sensor=(str, "name of the sensor"),
    seq=(Count, "index of the frame at the source; a dropped frame leaves a gap"),
    t=(Finite, "capture time, s: from the start of a recording, or Unix time if live"),
    size=(tuple[Pixels, Pixels], "(width, height) of the processed frame, px"),
    contact=(Contact | None, "null when nothing touches the gel"),
    contacts=(Contacts, "every separate contact, the one with the most pixels first"),
    flow=(Flow | None, "null when there is no contact"),
    markers=(Markers | None, "null when markers were not computed"),
    field=(Grid | None, "null without contact (only where the sink's field is true)", None),
    slip=(Slip | None, "of the contact (only where the pipeline has the stage slip)", None),
    scale=(Scale | None, "makes mm of px (calibrated)", None),
    force=(Force | None, "on the gel; only where something touches (calibrated)", None),
    pose=(Pose | None, "of the object (only where the pipeline has the stage pose; calibrated)", None),
    features=(Features | None, "of a network (only where a stage network gives features)", None),
    skipped=(
        dict[str, str],
        "port -> why this frame did not need it: unchanged and at_rest repeat the last value, by which a "
        "contact begins and ends at most one frame late; reference -> why this frame became a new one",
    ),
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
    schema = Message.model_json_schema(by_alias=True, schema_generator=_NoDefaults)
    return {"$schema": GenerateJsonSchema.schema_dialect, **schema}


def resolved(part: Mapping[str, Any], definitions: Mapping[str, Any]) -> dict[str, Any]:
    """A part of a JSON Schema with `$ref` and `anyOf` resolved, assuming that it is not null."""
    inner = next((choice for choice in part.get("anyOf", ()) if choice.get("type") != "null"), part)
    if "$ref" in inner:
        inner = definitions[inner["$ref"].rpartition("/")[2]]
    return {key: value for key, value in {**inner, **part}.items() if key not in ("$ref", "anyOf")}
