"""Sink `shm`: pictures and arrays for other processes on this machine, without copying them on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from tactflow.engine.contract import Sink
from tactflow.engine.errors import StageError
from tactflow.engine.ports import Port
from tactflow.message.result import MessageParams, Result, encode_message
from tactflow.vision.flow.displacement_field import DisplacementField
from tactflow.vision.types import Depth, Markers

from .door import Door, address_of
from .layout import MAX_DIMENSIONS, Picture

log = logging.getLogger("tactflow")

RAW: Final = "raw"
"""Name under which the captured picture is shared, as it came from the camera."""


class Shm(Sink):
    """Shares pictures and arrays with other processes on this machine: `tactflow.SharedReader` reads them.

    Each port has a ring of slots in shared memory. Beside each array lie its seq, its time and the message.
    Without readers no frame is requested, nothing is copied and no memory taken. A slow reader misses
    pictures; it never slows the run.

    Ports are the outputs of stages, by name: `image`, `annotated`, `unmarked`, `contact_mask`, `normals` and
    every other array, `depth` (heights, mm), `field` (displacement of the cells of its grid, px), `markers`
    (x, y in the reference, dx, dy); and `raw`, the captured picture. Names in `in:` are also ports.

    >>> import tactflow
    >>> sink = Shm(Shm.Params(ports=["raw"]), sensor="example")
    >>> sink.open()
    >>> with tactflow.SharedReader("example", "raw", timeout=60) as pictures:
    ...     sink.wait_for_reader(60)
    ...     sink.write(Result(tactflow.Frame("example", 36, 1.2, np.zeros((60, 80, 3), np.uint8))))
    ...     picture = pictures.read()
    True
    >>> picture.seq, picture.array.shape, picture.valid
    (36, (60, 80, 3), True)
    >>> sink.close()
    """

    threaded = True
    when_live = "latest"

    class Params(MessageParams):
        """Ports, memory, address, and content of the messages."""

        ports: Annotated[tuple[str, ...], Field(min_length=1, max_length=32)] = Field(
            ("image",),
            description="outputs to share, all of which are computed while any of them is read; raw is the "
            "captured picture",
        )
        slots: int = Field(
            8,
            ge=3,
            le=1024,
            description="pictures of each port in memory; one stays unchanged for slots - 1 frames",
        )
        socket: str | None = Field(
            None,
            min_length=1,
            description="file of the socket for readers, as for a container that has its folder; default: "
            "by the name of the sensor",
        )
        wait_for_reader: float = Field(0.0, ge=0, description="longest wait for a first reader, s")

        @field_validator("ports")
        @classmethod
        def _distinct(cls, ports: tuple[str, ...]) -> tuple[str, ...]:
            for port in ports:
                if not port.isidentifier():
                    raise ValueError(
                        f"required names of ports, got {port!r}; in: {{name: stage.port}} names one"
                    )
            if len(set(ports)) < len(ports):
                raise ValueError("required each port once")
            return ports

        def needed_inputs(self) -> Mapping[str, str]:
            """The ports, except for the captured picture."""
            return {port: "ports" for port in self.ports if port != RAW}

    @classmethod
    def declare(cls, params: Params) -> Sequence[Port]:
        """The ports that a result does not have anyway."""
        return [Port(name, object, optional=True) for name in _others(params)]

    def __init__(self, params: Params, sensor: str = "main") -> None:
        """Prepare; nothing is opened yet.

        sensor : names the address.
        """
        super().__init__(params)
        self._sensor = sensor
        self._others = _others(params)
        self._door: Door | None = None
        self._shared = 0

    def open(self) -> None:
        """Open the socket for readers, and wait for one if asked to.

        Raises StageError if another run shares a sensor of this name, or on Windows.
        """
        p = self.params
        self._door = Door(address_of(self._sensor, p.socket), p.ports, p.slots)
        self.description = f"{', '.join(p.ports)} of {self._sensor}"
        log.info("sharing %s", self.description)
        self.wait_for_reader(p.wait_for_reader)

    def wait_for_reader(self, seconds: float) -> bool:
        """Wait for a reader, at most `seconds`; returns whether there is one."""
        return self._door is not None and self._door.wait(seconds)

    def wants(self) -> bool:
        """Whether there are readers. Thread-safe; takes a microsecond."""
        return self._door is not None and self._door.readers > 0

    def counters(self) -> dict[str, int]:
        """shared : pictures written. readers : now."""
        return {"shared": self._shared, "readers": 0 if self._door is None else self._door.readers}

    def write(self, result: Result, *others: Any) -> None:
        """Share the ports that have readers; never waits for one.

        Raises StageError if a port is not an array of numbers, or there is no memory.
        """
        wanted = () if self._door is None else self._door.wanted
        if self._door is None or not wanted or result.frame.seq < 0:
            return
        message = encode_message(result, detail=self.params.detail, field=self.params.field)
        own = dict(zip(self._others, others, strict=True))
        for port in self.params.ports:
            if port not in wanted:
                continue
            value = result.frame.image if port == RAW else own.get(port, result.value(port))
            picture = Picture(result.seq, result.t, _array(port, value), message)
            try:
                self._door.publish(port, picture)
            except OSError as error:
                raise StageError(
                    f"{port}: cannot get shared memory: {error.strerror}; lower `slots`"
                ) from error
            self._shared += 1

    def close(self) -> None:
        """Let the readers know of the end. They keep the pictures that they have."""
        if self._door is not None:
            self._door.close()
            self._door = None


def _others(params: Shm.Params) -> list[str]:
    """The ports that a `Result` does not have."""
    return [port for port in params.ports if port != RAW and port not in Result.port_types()]


def _array(port: str, value: Any) -> NDArray[Any] | None:
    """The array of a port's value; None if it is absent."""
    if value is None:
        return None
    if isinstance(value, Depth):
        return value.heights
    if isinstance(value, DisplacementField):
        return value.displacement
    if isinstance(value, Markers):
        return np.hstack([value.origin, value.displacement])
    if not isinstance(value, np.ndarray):
        raise StageError(f"{port}: required an array, got {type(value).__name__}; the message has its values")
    if value.dtype.kind not in "biuf" or value.ndim > MAX_DIMENSIONS:
        required = f"an array of numbers with {MAX_DIMENSIONS} axes at most"
        raise StageError(f"{port}: required {required}, got {value.ndim} axes of {value.dtype}")
    return value
