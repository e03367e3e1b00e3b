"""Unpacking, never to more than was announced: a few bytes can be made to unpack to gigabytes."""

from __future__ import annotations

import zstandard


def unpacked(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """Unpack bytes that say how large they are.

    compression : "" (none), "zstd" or "lz4". size : bytes that there must be.

    Raises
    ------
    ValueError : they are damaged, of another size, or packed in another way.

    Examples
    --------
    >>> packed = zstandard.compress(bytes(1000))
    >>> len(unpacked(packed, "zstd", 1000))
    1000
    >>> unpacked(packed, "zstd", 10)
    Traceback (most recent call last):
    ValueError: required 10 bytes, got 1000
    """
    if compression == "":
        result = bytes(data)
    elif compression == "zstd":
        result = _unpack_zstd(data, size)
    elif compression == "lz4":
        result = _unpack_lz4(data, size)
    else:
        raise ValueError(f"packed as {compression!r}, which is not known here")
    if len(result) != size:
        raise ValueError(f"required {size} bytes, got {len(result)}")
    return result


def _unpack_zstd(data: bytes | memoryview, size: int) -> bytes:
    try:
        # The library takes the memory that the data asks for, whatever limit it is given.
        announced = zstandard.frame_content_size(data)
        if announced > size:
            raise ValueError(f"required {size} bytes, got {announced}")
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    except (zstandard.ZstdError, MemoryError) as error:
        raise ValueError(f"damaged ({error})") from error


def _unpack_lz4(data: bytes | memoryview, size: int) -> bytes:
    # mcap brings it along.
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    try:
        # One byte more than there should be, to see whether there is.
        return bytes(LZ4FrameDecompressor().decompress(bytes(data), max_length=size + 1))
    except (RuntimeError, EOFError, MemoryError) as error:
        raise ValueError(f"damaged ({error})") from error
