"""The result of a frame, in Python and as the message `tactflow.frame/1` (schema:
`tactflow.message.schema`)."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, Self, get_type_hints

import numpy as np
import orjson
from pydantic import Field, ValidationError

from tactflow.engine.contract import StageParams
from tactflow.engine.frame import NO_PICTURE, Absent, Frame, Tick, read_only
from tactflow.message.encoding import encode, to_json
from tactflow.message.fields import SCHEMA, Message
from tactflow.ports import ContactMask, Image, Normals
from tactflow.vision.types import Contact, Depth, Features, Flow, Force, Markers, Pose, Scale, Slip

if TYPE_CHECKING:
    from tactflow.vision.flow.displacement_field import DisplacementField


class Result(Tick):
    """The result of a frame: a mapping from port names to values, with properties for the well-known ports.

    Pixels are those of the processed frame, x right, y down. A property is None if nothing was found, or no
    stage of the pipeline computes it. `result["brightness"]` is the output of a stage of your own.

    Parameters
    ----------
    frame : as captured: `seq`, `t`, and the raw image; (0, 0, 3) if pictures were not kept.
    skipped : port -> why it was not computed in this frame; `unchanged` and `at_rest` repeat the last
        value.

    Attributes
    ----------
    image : (H, W, 3) uint8 BGR, the processed frame.
    contact, flow, markers : contact with the gel, displacement of the gel inside it, and markers.
    contact_mask : (H, W) uint8, 255 in contact.
    scale, depth, force : millimetres per pixel, indentation and force; only with a calibration of them.
    field, slip, normals : displacement field of the gel, slip of the contact, and normals of the gel's
        surface; only with the stages of these names.
    pose : motion of the object since it was touched; with the stage of that name and a calibration.
    features : output of a stage `network`.

    Examples
    --------
    >>> import tactflow
    >>> result = next(tactflow.stream(source="sim:press", max_frames=1))
    >>> result.seq, result.contact, len(result.markers.position)
    (0, None, 80)
    """

    __slots__ = ("_message", "_size")

    image: Image | None
    contact: Contact | None
    flow: Flow | None
    markers: Markers | None
    contact_mask: ContactMask | None
    scale: Scale | None
    depth: Depth | None
    normals: Normals | None
    field: DisplacementField | None
    slip: Slip | None
    force: Force | None
    pose: Pose | None
    features: Features | None

    def __init__(
        self,
        frame: Frame,
        values: Mapping[str, Any] | None = None,
        skipped: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(frame, values, skipped)
        self._size: tuple[int, int] | None = None
        self._message: dict[str, Any] | None = None

    @classmethod
    def port_types(cls) -> dict[str, Any]:
        """The types of the ports: those above, and further ones of the message. (Importing this module alone
        does not import OpenCV.)"""
        from tactflow.vision.flow.displacement_field import DisplacementField

        hints = get_type_hints(cls, localns={"DisplacementField": DisplacementField}, include_extras=True)
        return hints | {port: Any | None for port in Message.ports() if port not in hints}

    @property
    def contacts(self) -> tuple[Contact, ...]:
        """All separate contacts, the one with the most pixels first; empty without contact."""
        contact = self.contact
        return () if contact is None else contact.separate or (contact,)

    @property
    def sensor(self) -> str:
        """Name of the sensor."""
        return self.frame.sensor

    @property
    def seq(self) -> int:
        """Index of the frame at the source, from 0; a dropped frame leaves a gap."""
        return self.frame.seq

    @property
    def t(self) -> float:
        """Capture time, s: from the start of a recording, or Unix time of a live source."""
        return self.frame.t

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the processed frame, px; of the raw one if no stage processes it."""
        if self._size is not None:
            return self._size
        image = self.value("image")
        height, width = (self.frame.image if image is None else image).shape[:2]
        return width, height

    def to_dict(self, *, detail: bool = False, field: bool = False) -> dict[str, Any]:
        """The result message as dicts, lists and numbers; options as for `encode_message`.

        For a received result, the original message.
        """
        if self._message is not None:
            return self._message
        message: dict[str, Any] = orjson.loads(encode_message(self, detail=detail, field=field))
        return message

    def to_json(self, *, detail: bool = False, field: bool = False) -> str:
        """The result message as JSON on one line; options as for `encode_message`."""
        return encode_message(self, detail=detail, field=field).decode()

    def kept(self, *, pictures: bool) -> Self:
        """A copy with read-only arrays, optionally without pictures."""
        kept = copy(self)
        kept._size = self.size
        values = {port: _read_only(value) for port, value in self.items()}
        if not pictures:
            values = {port: value for port, value in values.items() if not _is_picture(value)}
            kept.frame = replace(self.frame, image=NO_PICTURE)
        kept._values = values
        return kept

    @classmethod
    def from_message(cls, message: Mapping[str, Any] | bytes | str) -> Self:
        """Decode a message; the result has no pictures, masks or height maps.

        Raises
        ------
        ValueError : the message is not a result message.
        """
        try:
            parsed: Any = message if isinstance(message, Mapping) else orjson.loads(message)
            read = Message.model_validate(_completed(parsed))
        except ValidationError as error:
            problem = error.errors(include_url=False)[0]
            place = ".".join(map(str, problem["loc"]))
            raise ValueError(f"required a message {SCHEMA}: {place}: {problem['msg']}") from None
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"required a message {SCHEMA}: {type(error).__name__}: {error}") from None
        values = {
            port: Absent(read.skipped.get(port, "none")) if value is None else value
            for port, value in read.decoded_ports().items()
        }
        result = cls(Frame(read.sensor, read.seq, read.t, NO_PICTURE), values, read.skipped)
        result._size = read.size
        result._message = parsed
        return result


def _completed(message: Any) -> Any:
    """The message with the values of the keys that other programs may leave out."""
    if not isinstance(message, Mapping):
        return message
    completed = {"size": (1, 1), "contacts": [], **message}
    if isinstance(contact := message.get("contact"), Mapping):
        completed["contact"] = {"evidence": "light", "probability": None, **contact}
    return completed


class MessageParams(StageParams):
    """Parameters of a sink that writes or publishes messages: the options of `encode_message`."""

    detail: bool = Field(False, description="also confidence, rotation, divergence, shear, standard errors")
    field: bool = Field(False, description="also the displacement field: some 100 kB a frame")


def _is_picture(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.uint8 and value.shape[2:] == (3,)


def _read_only(value: Any) -> Any:
    """The value with read-only arrays: an array, or a dataclass with arrays."""
    if isinstance(value, np.ndarray):
        return read_only(value)
    if isinstance(value, tuple) and type(value) is tuple:
        return tuple(map(_read_only, value))
    if not is_dataclass(value) or isinstance(value, type):
        return value
    parts = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
    locked = {name: _read_only(part) for name, part in parts.items()}
    return replace(value, **{name: part for name, part in locked.items() if part is not parts[name]})


def encode_message(result: Result, *, detail: bool = False, field: bool = False) -> bytes:
    """Encode the result message of a frame as JSON in UTF-8, on a single line without a line end.

    Parameters
    ----------
    result : in pixels of the processed frame; None becomes null.
    detail : include `contact.confidence`, `flow.stderr`, `flow.rotation`, `flow.divergence`, `flow.residual`,
        `flow.shear`, `markers.stderr`, and the standard errors of these and of all values in mm.
    field : include `field`.

    Raises
    ------
    ValueError
        If a number is infinite, or NaN (except in standard errors, where NaN means unknown).
    """
    return to_json(encode(result, detail, field) if result._message is None else result._message)
