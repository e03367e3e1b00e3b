"""As much of Protocol Buffers as recordings need: writing and reading one message, and describing its type.

The wire format is described at https://protobuf.dev/programming-guides/encoding. Frames are written and read
here without a copy; types are described by Google's package.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from typing import Literal

from google.protobuf.descriptor_pb2 import (  # type: ignore[import-untyped]
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from google.protobuf.timestamp_pb2 import Timestamp  # type: ignore[import-untyped]

Value = bool | int | float | str | bytes | memoryview
FieldType = Literal["double", "int64", "int32", "bool", "string", "bytes", "uint32", "sint64", "Timestamp"]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def encode(fields: Iterable[tuple[int, Value]]) -> bytes:
    """One message. Integers are written as varints, floats as doubles.

    fields : (number, value) in the order they are to be written; a number may come several times.

    >>> decode(encode([(1, 300), (2, 0.5)]))
    {1: 300, 2: 0.5}
    """
    parts: list[bytes | memoryview] = []
    for number, value in fields:
        if isinstance(value, int):
            parts += (_varint(number << 3 | _VARINT), _varint(value & 0xFFFFFFFFFFFFFFFF))
        elif isinstance(value, float):
            parts += (_varint(number << 3 | _FIXED64), struct.pack("<d", value))
        else:
            data = value.encode() if isinstance(value, str) else value
            parts += (_varint(number << 3 | _BYTES), _varint(len(data)), data)
    return b"".join(parts)


def decode(data: bytes | memoryview) -> dict[int, int | float | memoryview]:
    """The fields of one message by number; of one that comes several times, the last.

    Varints come as unsigned integers, 64-bit fields as doubles, all else as bytes; nothing is copied.

    Raises
    ------
    ValueError
        If the bytes are no such message.
    """
    view = memoryview(data)
    fields: dict[int, int | float | memoryview] = {}
    at = 0
    try:
        while at < len(view):
            key, at = _read_varint(view, at)
            kind = key & 7
            if kind == _VARINT:
                fields[key >> 3], at = _read_varint(view, at)
            elif kind == _FIXED64:
                (fields[key >> 3],) = struct.unpack_from("<d", view, at)
                at += 8
            elif kind == _BYTES:
                length, at = _read_varint(view, at)
                if at + length > len(view):
                    raise ValueError(f"required {length} bytes, got {len(view) - at}")
                fields[key >> 3] = view[at : at + length]
                at += length
            elif kind == _FIXED32:
                at += 4
            else:
                raise ValueError(f"required a wire type of 0, 1, 2 or 5, got {kind}")
    except (IndexError, struct.error):
        raise ValueError("the message is cut off") from None
    return fields


def zigzag(number: int) -> int:
    """A signed integer as `sint64` stores it: 0, -1, 1, -2, ... become 0, 1, 2, 3, ...

    >>> [zigzag(number) for number in (0, -1, 1, -2)]
    [0, 1, 2, 3]
    """
    return number * 2 if number >= 0 else -number * 2 - 1


def unzigzag(number: int) -> int:
    """The inverse of `zigzag`.

    >>> unzigzag(zigzag(-12))
    -12
    """
    return number >> 1 if number & 1 == 0 else -(number >> 1) - 1


def timestamp(nanoseconds: int) -> bytes:
    """A `google.protobuf.Timestamp`, from ns."""
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return encode([(1, seconds), (2, rest)])


def describe(name: str, fields: Sequence[tuple[str, int, FieldType]]) -> bytes:
    """The `FileDescriptorSet` of one flat message type.

    name : with its package, such as "foxglove.CompressedImage". fields : (name, number, type).
    """
    package, _, short = name.rpartition(".")
    time = FileDescriptorProto()
    Timestamp.DESCRIPTOR.file.CopyToProto(time)
    file = FileDescriptorProto(
        name=f"{package}/{short}.proto", package=package, dependency=[time.name], syntax="proto3"
    )
    message = file.message_type.add(name=short)
    for field, number, kind in fields:
        described = message.field.add(name=field, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
        if kind == "Timestamp":
            described.type = FieldDescriptorProto.TYPE_MESSAGE
            described.type_name = f".{Timestamp.DESCRIPTOR.full_name}"
        else:
            described.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
    return bytes(FileDescriptorSet(file=[time, file]).SerializeToString())


def _varint(number: int) -> bytes:
    parts = bytearray()
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    parts.append(number)
    return bytes(parts)


def _read_varint(view: memoryview, at: int) -> tuple[int, int]:
    number = shift = 0
    while True:
        byte = view[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
        if shift > 63:
            raise ValueError("required a number of 64 bits, got a longer one")
