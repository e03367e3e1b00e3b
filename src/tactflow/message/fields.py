"""The result message `tactflow.frame/1`: every key with its type, its meaning and the source of its value.

This is its only description. The encoder, the decoder, the JSON Schema, the columns of tables and the tables
in docs/results.md are derived from it. A class is an object of the message; its `of` is the Python value that
it is made of, and is decoded to. A key takes the attribute of its name, or the port of its name in `Message`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
import pydantic
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, PlainValidator, SkipValidation

from tactflow.engine.frame import Tick
from tactflow.vision import types
from tactflow.vision.types import MarkerStatus

SCHEMA = "tactflow.frame/1"
STATUS_NAMES = tuple(status.name.lower() for status in sorted(MarkerStatus))
"""The word for each value of `MarkerStatus`."""
EXPLAINED_PORTS = frozenset({"contact", "flow", "markers", "reference"})
"""Keys of `skipped`: the ports of every message, and the reference."""
CONDITIONS = {
    **dict.fromkeys(("scale", "depth", "normals"), "calibrated"),
    "contact_mask": "only with the stage normals",
    "detail": "detail",
    "field": "only where the sink's field is true",
}
"""What a key may need, a port or an option of `encode_message` -> how its description says so."""

Finite = Annotated[float, pydantic.Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite]
Vector = tuple[Finite, Finite, Finite]
Angle = Annotated[float, pydantic.Field(gt=-90, le=90, allow_inf_nan=False)]
Positive = Annotated[float, pydantic.Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, pydantic.Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, pydantic.Field(ge=0, le=1)]
Error = NotNegative | None
Errors = tuple[NotNegative, NotNegative, NotNegative, NotNegative, NotNegative, NotNegative]
Count = Annotated[int, pydantic.Field(ge=0, strict=True)]
Pixels = Annotated[int, pydantic.Field(gt=0)]
Status = Literal["tracked", "inferred", "lost"]


def _numbers(values: Any) -> NDArray[np.float64]:
    """Decode numbers; null is NaN."""
    return np.array(values, np.float64)


def _points(values: Any) -> NDArray[np.float64]:
    points = np.array(values, np.float64)
    if not points.size:
        return points.reshape(0, 2)
    if points.shape[1:] != (2,) or not np.isfinite(points).all():
        raise ValueError("required pairs of finite numbers")
    return points


def _singles(values: Any) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def _statuses(names: Any) -> NDArray[np.uint8]:
    return np.array([STATUS_NAMES.index(name) for name in names], np.uint8)


Numbers = Annotated[NDArray[np.float64], PlainValidator(_numbers, json_schema_input_type=list[Finite])]
Singles = Annotated[NDArray[np.float32], PlainValidator(_singles, json_schema_input_type=list[Finite])]
KnownErrors = Annotated[NDArray[np.float64], PlainValidator(_numbers, json_schema_input_type=list[Error])]
KnownShares = Annotated[
    NDArray[np.float64], PlainValidator(_numbers, json_schema_input_type=list[Share | None])
]
Points = Annotated[NDArray[np.float64], PlainValidator(_points, json_schema_input_type=list[Point])]
Statuses = Annotated[NDArray[np.uint8], PlainValidator(_statuses, json_schema_input_type=list[Status])]
"""Arrays, which are lists in JSON."""


@dataclass(frozen=True, slots=True)
class Sending:
    """When a key is sent, and with which value.

    Attributes
    ----------
    unit : of the numbers; empty without one.
    needs : keys of `CONDITIONS` that must all be given.
    if_known : whether it is left out instead of null.
    value : function of the value that the part is made of, and of the whole result; None: the attribute, or
        the port, of the key's name.
    elements : names of the elements of a tuple that are not x, y and z.
    """

    unit: str = ""
    needs: tuple[str, ...] = ()
    if_known: bool = False
    value: Callable[[Any, Any], Any] | None = None
    elements: tuple[str, ...] = ()

    def __call__(self, schema: dict[str, Any]) -> None:
        """Complete the JSON Schema of the key: its unit, and the names of the elements."""
        if self.unit:
            schema["unit"] = self.unit
        for choice in (schema, *schema.get("anyOf", ())):
            for element, name in zip(choice.get("prefixItems", ()), self.elements, strict=False):
                element["title"] = name


class Key(NamedTuple):
    """A key of a part.

    Attributes
    ----------
    part : of the objects that it holds.
    """

    name: str
    sending: Any
    part: "type[Part] | None" = None


def sent(
    meaning: str,
    unit: str = "",
    *,
    null: str = "",
    needs: tuple[str, ...] = (),
    alias: str | None = None,
    **sending: Any,
) -> Any:
    """A key of the message.

    meaning : of its value. null : when it is null. alias : the key, if it is not the attribute's name. For
    the others, see `Sending`.
    """
    conditions = ", ".join(dict.fromkeys(CONDITIONS[need] for need in needs))
    texts = (meaning, unit and f", {unit}", null and f"; null {null}", conditions and f" ({conditions})")
    return pydantic.Field(
        default=None if needs or sending.get("if_known") else ...,
        alias=alias,
        description="".join(texts),
        json_schema_extra=Sending(unit, needs, **sending),
    )


class Part(BaseModel):
    """An object of the message.

    Attributes
    ----------
    of : the class of its value in Python; None if it is not decoded.
    source : gives the default value of a key, from the value of the part.
    repeats : whether its value is often that of the frame before. Its keys must not depend on other values.
    """

    # Keys of a later version are ignored when read, but are errors for the schema.
    model_config = ConfigDict(
        frozen=True,
        defer_build=True,
        field_title_generator=lambda name, info: info.alias or name,
        json_schema_extra={"additionalProperties": False},
    )
    of: ClassVar[type | None] = None
    source: ClassVar[Callable[[Any, str], Any]] = getattr
    repeats: ClassVar[bool] = False

    @classmethod
    def all_keys(cls) -> Iterator[Key]:
        """The keys in the order of the message."""
        for name, field in cls.model_fields.items():
            kinds = (field.annotation, *get_args(field.annotation))
            parts = [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, Part)]
            yield Key(field.alias or name, field.json_schema_extra, *parts)

    def decoded(self, **more: Any) -> Any:
        """The value in Python. more : further attributes."""
        if self.of is None:
            return None
        names = _attributes(self.of) & self.model_fields_set
        return self.of(**({name: _decoded(getattr(self, name)) for name in names} | more))


@cache
def _attributes(kind: type) -> frozenset[str]:
    return frozenset(attribute.name for attribute in fields(kind))


def _decoded(value: Any) -> Any:
    return value.decoded() if isinstance(value, Part) else value


class Ellipse(Part):
    """Ellipse fitted to the contact."""

    of = types.Ellipse
    center: Point = sent("(x, y)", "px")
    axes: tuple[Positive, Positive] = sent("full lengths (major, minor)", "px", elements=("major", "minor"))
    angle: Angle | None = sent("of the major axis", "degrees", null="for a circle")


class SeparateContact(Part):
    """Geometry of a contact."""

    of = types.Contact
    area: NotNegative = sent("of the convex hull of the imprint, up to its outer edge", "px^2")
    center: Point = sent("centroid of the contact region", "px")
    angle: Angle | None = sent(
        "principal axis, counter-clockwise as seen", "degrees", null="without a direction"
    )
    slope: Finite | None = sent(
        "dy/dx of that axis, y down", null="where it is vertical or there is no direction"
    )
    hull: Points = sent("vertices of the convex hull in order", "px")
    ellipse: Ellipse | None = sent("fitted to the region", null="where none can be fitted")
    evidence: types.Evidence = sent(
        "what shows it: a change of the light, motion of the markers (dots), or both"
    )
    probability: Share | None = sent(
        "of being a contact; below 0.5 it is unsure (absent if not known)", if_known=True
    )
    core_area: NotNegative | None = sent(
        "of the convex hull of the core, where the gel clings to the object (absent if not known)",
        "px^2",
        if_known=True,
    )
    center_mm: Point | None = sent(
        "center from the scale's origin",
        "mm",
        needs=("scale",),
        value=lambda contact, result: result.scale.point(contact.center),
    )
    area_mm2: NotNegative | None = sent(
        "area", "mm^2", needs=("scale",), value=lambda contact, result: result.scale.area(contact.area)
    )
    core_area_mm2: NotNegative | None = sent(
        "core_area",
        "mm^2",
        needs=("scale",),
        if_known=True,
        value=lambda contact, result: (
            None if contact.core_area is None else result.scale.area(contact.core_area)
        ),
    )
    confidence: Share = sent("of the direction: 0 a disc, towards 1 a line", needs=("detail",))
    center_mm_stderr: Point | None = sent(
        "error due to the scale",
        "mm",
        needs=("scale", "detail"),
        value=lambda contact, result: result.scale.point_stderr(contact.center),
    )
    area_mm2_stderr: NotNegative | None = sent(
        "error due to the scale",
        "mm^2",
        needs=("scale", "detail"),
        value=lambda contact, result: result.scale.area_stderr(contact.area),
    )


def _mean_normal(_: types.Contact, result: Any) -> list[float] | None:
    """Unit vector along the sum of the normals in the contact; None without any."""
    # Only here: who reads messages needs no OpenCV.
    from tactflow.vision.depth.normals import mean_normal

    mean = mean_normal(result.normals, result.contact_mask)
    return None if mean is None else mean.tolist()


class Contact(SeparateContact):
    """Geometry of the contact region."""

    depth_mm: NotNegative | None = sent(
        "greatest indentation of the surface",
        "mm",
        needs=("depth",),
        value=lambda _, result: result.depth.greatest,
    )
    volume_mm3: NotNegative | None = sent(
        "between untouched and pressed surface",
        "mm^3",
        needs=("depth",),
        value=lambda _, result: result.depth.volume,
    )
    depth_mm_stderr: NotNegative | None = sent(
        "standard error of depth_mm",
        "mm",
        null="when unknown",
        needs=("depth", "detail"),
        value=lambda _, result: result.depth.greatest_stderr,
    )
    volume_mm3_stderr: NotNegative | None = sent(
        "standard error of volume_mm3",
        "mm^3",
        null="when unknown",
        needs=("depth", "detail"),
        value=lambda _, result: result.depth.volume_stderr,
    )
    normal: Vector | None = sent(
        "mean unit normal of the gel's surface, out of the gel: x right, y down",
        needs=("normals", "contact_mask"),
        value=_mean_normal,
    )

    def decoded_depth(self) -> types.Depth | None:
        """The depth without its heights; None if the message has none."""
        if self.depth_mm is None or self.volume_mm3 is None:
            return None
        numbers = self.depth_mm, self.depth_mm_stderr, self.volume_mm3, self.volume_mm3_stderr
        return types.Depth(np.zeros((0, 0), np.float32), *numbers)


def _mean_mm_stderr(flow: types.Flow, result: Any) -> tuple[float, float] | None:
    is_known = flow.mean is not None and flow.stderr is not None
    return result.scale.vector_stderr(flow.mean, flow.stderr) if is_known else None


class Flow(Part):
    """Motion of the gel inside the contact."""

    of = types.Flow
    mean: Point | None = sent("mean displacement (dx, dy)", "px", null="when not known")
    count: Count = sent("number of markers inside the contact")
    mean_mm: Point | None = sent(
        "mean",
        "mm",
        null="when not known",
        needs=("scale",),
        value=lambda flow, result: None if flow.mean is None else result.scale.vector(flow.mean),
    )
    mean_mm_stderr: Point | None = sent(
        "standard error of mean_mm", "mm", needs=("scale", "detail"), if_known=True, value=_mean_mm_stderr
    )
    stderr: Point | None = sent("standard error of mean", "px", null="when unknown", needs=("detail",))
    rotation: Finite | None = sent(
        "twist, counter-clockwise as seen", "degrees", null="when unknown", needs=("detail",)
    )
    divergence: Finite | None = sent(
        "relative growth in area of the gel", null="when unknown", needs=("detail",)
    )
    residual: Finite | None = sent(
        "RMS of what these leave unexplained", "px", null="when unknown", needs=("detail",)
    )
    rotation_stderr: Positive | None = sent(
        "standard error of rotation", "degrees", null="when unknown", needs=("detail",)
    )
    divergence_stderr: Positive | None = sent(
        "standard error of divergence", null="when unknown", needs=("detail",)
    )
    shear_stderr: Positive | None = sent(
        "standard error of each part of shear", null="when unknown", needs=("detail",)
    )
    shear: Point | None = sent(
        "(du/dx - dv/dy, du/dy + dv/dx), displacement (u, v)",
        null="when unknown",
        needs=("detail",),
        elements=("1", "2"),
    )


class Markers(Part):
    """The markers; index i is the same physical marker for the whole run. Ones found later come last."""

    of = types.Markers
    repeats = True
    origin: Points = sent("positions in the reference frame", "px")
    position: Points = sent("positions now; repeated while none can have moved by more than 0.05 px", "px")
    status: Statuses = sent(
        "how each position is known",
        value=lambda markers, _: [STATUS_NAMES[value] for value in markers.status.tolist()],
    )
    probability: KnownShares = sent(
        "of each being a marker at all", null="when unknown", needs=("detail",), if_known=True
    )
    stderr: KnownErrors = sent("standard error of each", "px", null="when unknown", needs=("detail",))

    def decoded(self, **_: Any) -> Any:
        """The markers; without errors in the message, they are NaN."""
        unknown = np.full(len(self.origin), math.nan)
        return super().decoded(stderr=unknown if self.stderr is None else self.stderr)


class Scale(Part):
    """Millimetres of pixels: mm = mm_per_px * (px - origin) along each axis."""

    of = types.Scale
    mm_per_px: tuple[Positive, Positive] = sent(
        "along (x, y)", "mm per px", value=lambda scale, _: (scale.x, scale.y)
    )
    origin: Point = sent("(x, y) where the mm coordinates are 0", "px")

    def decoded(self, **_: Any) -> Any:
        """The scale, with unknown errors."""
        x, y = self.mm_per_px
        return super().decoded(x=x, y=y, stderr=(math.nan, math.nan))


def _translation_mm(slip: types.Slip, result: Any) -> tuple[float, float] | None:
    return None if slip.translation is None else result.scale.vector(slip.translation)


def _speed_mm(slip: types.Slip, result: Any) -> float | None:
    return None if slip.speed is None else slip.speed * math.sqrt(result.scale.x * result.scale.y)


class Slip(Part):
    """Motion of the object relative to the gel."""

    of = types.Slip
    slipping: bool = sent("whether it slips: two of three frames have clearly shown it")
    stick_ratio: Share = sent("share of the contact on which the gel moves with it; 0 while it slides")
    probability: Share | None = sent("that it slips, from all frames up to now", null="when unknown")
    kind: types.SlipKind | None = sent(
        "of the slip: slow; fast; too fast to be followed", null="while it does not slip"
    )
    onset: Finite | None = sent("when it began", "s", null="while it does not slip")
    translation: Point | None = sent("(x, y), how far the middle of the contact has moved over the gel", "px")
    rotation: Finite | None = sent("how far it has turned on the gel, counter-clockwise as seen", "degrees")
    speed: NotNegative | None = sent("RMS over the contact", "px/s", null="in the first frame")
    since: Count | None = sent("seq of the frame from which translation and rotation are measured")
    translation_mm: Point | None = sent("translation", "mm", needs=("scale",), value=_translation_mm)
    speed_mm: NotNegative | None = sent("speed", "mm/s", needs=("scale",), value=_speed_mm)
    translation_stderr: tuple[NotNegative, NotNegative] | None = sent(
        "standard error of translation", "px", null="when unknown", needs=("detail",)
    )
    rotation_stderr: NotNegative | None = sent(
        "standard error of rotation", "degrees", null="when unknown", needs=("detail",)
    )
    speed_stderr: NotNegative | None = sent(
        "standard error of speed", "px/s", null="when unknown", needs=("detail",)
    )


def _unlike_calibration(force: types.Force, _result: Any) -> bool | None:
    return None if force.as_calibrated else False


class Force(Part):
    """The force on the gel."""

    of = types.Force
    value: tuple[Finite | None, Finite | None, NotNegative] = sent(
        "(x, y, z): z presses on the gel, x and y drag it", "N", null="when unknown"
    )
    stderr: tuple[Error, Error, Error] = sent("standard errors", "N", null="when unknown")
    in_range: bool = sent("whether the calibration was fitted to such contacts; stderr only holds there")
    torque: Finite | None = sent(
        "about z through the center of the contact, from x to y (absent if not known)", "N mm", if_known=True
    )
    as_calibrated: bool | None = sent(
        "false where the gel at rest or a known load differs from the calibration, so that stderr is wider "
        "(absent otherwise)",
        if_known=True,
        value=_unlike_calibration,
    )


class Pose(Part):
    """Motion of the object since it was touched."""

    of = types.Pose
    status: Literal["tracked", "lost"] = sent(
        "lost: no match; repeats the frame before, starts anew in the next"
    )
    since: Count = sent("seq of the frame in which it was touched, or tracked anew")
    center: Vector = sent("(x, y, z), middle of the contact then: x right, y down, z out of the gel", "mm")
    translation: Vector = sent("(x, y, z) of this point of the object since then", "mm")
    rotation: Vector = sent("rotation vector of the object about this point", "degrees")
    stderr: Errors = sent("standard errors of translation, mm, and rotation, degrees")
    covariance: Numbers = sent(
        "of these six, (6, 6) row by row, mm and degrees",
        needs=("detail",),
        value=lambda pose, _: pose.covariance.ravel(),
    )

    def decoded(self, **_: Any) -> Any:
        """The pose. Without a covariance in the message, only the variances are known."""
        numbers = np.diag(np.square(self.stderr)) if self.covariance is None else self.covariance
        return super().decoded(covariance=numbers.reshape(6, 6))


class Features(Part):
    """Output of a network of the user."""

    of = types.Features
    values: Singles = sent("as many numbers as the network gives")
    unit: str = sent("of the numbers")


class Field(Part):
    """Displacement of the gel on a regular grid."""

    first: Point = sent(
        "(x, y) of row 0, column 0, in the reference frame", "px", value=lambda field, _: field.grid.first
    )
    spacing: Positive = sent(
        "from one point to the next along both axes", "px", value=lambda field, _: field.grid.spacing
    )
    displacement: SkipValidation[list[list[Point]]] = sent("rows of (dx, dy)", "px")
    stderr: SkipValidation[list[list[NotNegative]]] = sent("standard error of each component, rows", "px")


def _explained(result: Any, _: Any) -> dict[str, str]:
    return {port: reason for port, reason in result.skipped.items() if port in EXPLAINED_PORTS}


class Message(Part):
    """The results of one processed frame."""

    model_config = ConfigDict(title=SCHEMA)
    source = Tick.value
    schema_: Literal["tactflow.frame/1"] = sent(
        "the kind of message", alias="schema", value=lambda *_: SCHEMA
    )
    sensor: str = sent("name of the sensor", value=lambda result, _: result.sensor)
    seq: Count = sent(
        "index of the frame at the source; a dropped frame leaves a gap", value=lambda result, _: result.seq
    )
    t: Finite = sent(
        "capture time: from the start of a recording, or Unix time if live",
        "s",
        value=lambda result, _: result.t,
    )
    size: tuple[Pixels, Pixels] = sent(
        "(width, height) of the processed frame",
        "px",
        value=lambda result, _: result.size,
        elements=("width", "height"),
    )
    contact: Contact | None = sent("the contact region", null="when nothing touches the gel")
    contacts: list[SeparateContact] = sent(
        "every separate contact, the one with the most pixels first", value=lambda result, _: result.contacts
    )
    flow: Flow | None = sent("motion of the gel in contact", null="when there is no contact")
    markers: Markers | None = sent(
        "the dots, always in the same order", null="when markers were not computed"
    )
    skipped: dict[str, str] = sent(
        "port -> why this frame did not need it: unchanged and at_rest repeat the last value, by which a "
        "contact begins and ends at most one frame late; reference -> why this frame became a new one",
        value=_explained,
    )
    scale: Scale | None = sent("makes mm of px (calibrated)", if_known=True)
    slip: Slip | None = sent("of the contact (only where the pipeline has the stage slip)", if_known=True)
    force: Force | None = sent(
        "on the gel, where something touches; by dots, in every frame (calibrated)", if_known=True
    )
    pose: Pose | None = sent(
        "of the object (only where the pipeline has the stage pose; calibrated)", if_known=True
    )
    features: Features | None = sent(
        "of a network (only where a stage network gives features)", if_known=True
    )
    field: Field | None = sent("displacement on a grid", null="without contact", needs=("field",))

    @classmethod
    @cache
    def ports(cls) -> list[str]:
        """The ports that are keys of a message."""
        return [key.name for key in cls.all_keys() if key.sending.value is None]

    def decoded_ports(self) -> dict[str, Any]:
        """Port -> value, None without."""
        values = {port: _decoded(getattr(self, port)) for port in self.ports()}
        if self.contact is not None:
            values["depth"] = self.contact.decoded_depth()
            if len(self.contacts) > 1:
                separate = tuple(map(_decoded, self.contacts))
                values["contact"] = self.contact.decoded(separate=separate)
        return values
