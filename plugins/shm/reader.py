"""`tactflow.SharedReader`: pictures and arrays of a running tactflow, from shared memory."""

from __future__ import annotations

import math
import os
import select
import socket as sockets
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from typing import Any, Final, Self

import orjson
from numpy.typing import NDArray

from tactflow.engine.errors import StageError
from tactflow.message.result import Result

from .door import REFUSAL, RETRY_SECONDS, address_of, may_talk
from .layout import Picture, RingView

MAX_ANSWER_BYTES: Final = 4096
"""Bytes read from the socket at once: more than its queue holds messages of one byte."""
MAX_RINGS_AT_ONCE: Final = 4
"""Descriptors taken from the socket at once; a single message has one."""
MAX_TIMEOUT_S: Final = 1e6
"""Longest timeout, s (11 days): the system counts milliseconds in 31 bits."""


class SharedPicture:
    """A picture, or another array, in the shared memory of a running tactflow.

    Attributes
    ----------
    array : the value of the port in this frame, read-only, not a copy; None where it is absent, and then
        `message["skipped"]` may say why. It is overwritten some frames later: see `valid`.
    seq : index of the frame at the source.
    t : capture time, s: from the start of a recording, or Unix time of a live source.
    json : the message of this frame, JSON in UTF-8. Like seq and t it is a copy, and stays whole.
    generation : of the memory; another one after tactflow was restarted.
    """

    def __init__(self, picture: Picture, ring: RingView, number: int, *, whole: bool = False) -> None:
        self.array: NDArray[Any] | None = picture.array
        self.seq, self.t, self.json = picture.seq, picture.t, picture.message
        self.generation = ring.generation
        self._ring, self._number, self._whole = ring, number, whole

    @property
    def valid(self) -> bool:
        """Whether the array is still that of this frame; ask after use.

        It stays so for `slots - 1` frames (117 ms at 60 Hz and 8 slots), and for ever if tactflow has ended.
        """
        return self._whole or self._ring.holds(self._number)

    @cached_property
    def message(self) -> dict[str, Any]:
        """The message of this frame."""
        parsed: dict[str, Any] = orjson.loads(self.json)
        return parsed

    @cached_property
    def result(self) -> Result:
        """The message as a `Result`."""
        return Result.from_message(self.message)

    def copy(self) -> SharedPicture:
        """A copy that nothing overwrites, guaranteed whole.

        Raises
        ------
        BufferError : the picture has been overwritten already.
        """
        array = None if self.array is None else self.array.copy()
        if not self.valid:
            raise BufferError(
                f"picture {self.seq} has been overwritten; copy it sooner, or raise sinks.shm.slots "
                f"(now {self._ring.slots})"
            )
        picture = Picture(self.seq, self.t, array, self.json)
        return SharedPicture(picture, self._ring, self._number, whole=True)

    def __repr__(self) -> str:
        kind = "absent" if self.array is None else f"{self.array.shape} {self.array.dtype}"
        return f"<SharedPicture {self.seq} at {self.t:.3f} s: {kind}>"


class SharedReader:
    """Reads one port of a running tactflow with the sink `shm`; a context manager and an iterator.

    Use it in one thread at a time, in any process of the same user on the same machine. Connecting does not
    wait: tactflow may start before or after, and be started again.

    Parameters
    ----------
    sensor : name of the sensor.
    port : one of `sinks.shm.ports`.
    latest : skip to the newest picture, for control loops. Otherwise pictures come in order, without those
        that were overwritten before.
    timeout : longest time without a picture before a TimeoutError, s, 1e6 at most; None waits forever.
    socket : `sinks.shm.socket`, if that is set.

    Attributes
    ----------
    lost : pictures so far that were overwritten, or skipped by `latest`.

    Raises
    ------
    ValueError : the timeout is out of range. StageError on Windows.

    Examples
    --------
    >>> import tactflow
    >>> with tactflow.SharedReader("left", "image", timeout=0.1) as pictures:
    ...     pictures.lost  # `for picture in pictures:` waits for them
    0
    """

    def __init__(
        self,
        sensor: str = "main",
        port: str = "image",
        *,
        latest: bool = True,
        timeout: float | None = None,
        socket: str | None = None,
    ) -> None:
        if timeout is not None and not 0 <= timeout <= MAX_TIMEOUT_S:
            raise ValueError(f"timeout: required None or 0 to {MAX_TIMEOUT_S:g} seconds, got {timeout}")
        self.lost = 0
        self._sensor, self._port, self._latest, self._timeout = sensor, port, latest, timeout
        self._address = address_of(sensor, socket)
        self._socket: sockets.socket | None = None
        self._rings: deque[RingView] = deque()
        self._last = 0
        self._connect()

    @property
    def generation(self) -> int | None:
        """Identifies the memory that is read: another one after tactflow was restarted. None before."""
        return self._rings[0].generation if self._rings else None

    @property
    def connected(self) -> bool:
        """Whether the run was there when the reader last looked."""
        return self._socket is not None

    def read(self) -> SharedPicture:
        """Wait for a picture that was not read yet.

        Raises
        ------
        TimeoutError : none came for `timeout` seconds.
        StageError : the run does not share this port, or belongs to another user.
        """
        deadline = math.inf if self._timeout is None else time.monotonic() + self._timeout
        while (picture := self._next()) is None:
            if not self._wait(deadline):
                raise TimeoutError(
                    f"no picture of {self._sensor}, {self._port}, for {self._timeout:g} s; is tactflow "
                    f"running with sinks.shm={{ports: [{self._port}]}}, and its sensor called {self._sensor}?"
                )
        return picture

    def find(self, seq: int) -> SharedPicture | None:
        """The picture of a frame, if it is still in memory, as to match pictures of two ports.

        It does not wait, and does not count as read.
        """
        self._hear()
        for ring in reversed(self._rings):
            for number in range(ring.newest, ring.oldest - 1, -1):
                picture = ring.read(number)
                if picture is not None and picture.seq == seq:
                    return SharedPicture(picture, ring, number)
        return None

    def _next(self) -> SharedPicture | None:
        """The next picture that is there already."""
        self._hear()
        while self._rings:
            is_last = len(self._rings) == 1
            ring = self._rings[0]
            newest = ring.newest
            if newest == self._last or (self._latest and not is_last):
                if is_last:
                    return None
                self.lost += newest - self._last
                self._rings.popleft()
                self._last = 0
                continue
            number = newest if self._latest else max(self._last + 1, ring.oldest)
            picture = ring.read(number)
            if picture is not None:
                # What was there before the first picture that we read was not ours to lose.
                self.lost += number - self._last - 1 if self._last else 0
                self._last = number
                return SharedPicture(picture, ring, number)
        return None

    def _connect(self) -> None:
        """Ask for the port, if a run is there."""
        if sys.platform == "win32":
            raise NotImplementedError
        connection = sockets.socket(sockets.AF_UNIX, sockets.SOCK_STREAM)
        try:
            connection.connect(self._address)
            if not may_talk(connection, self._address):
                raise StageError("the run belongs to another user")
            connection.sendall(f"{self._port}\n".encode())
            connection.setblocking(False)
        except (ConnectionError, FileNotFoundError):
            connection.close()
        except (OSError, StageError) as error:
            connection.close()
            raise StageError(f"cannot read pictures of {self._sensor}: {error}") from error
        else:
            self._socket = connection

    def _wait(self, until: float) -> bool:
        """Wait for news from the run, or until it is there; False at a time of `time.monotonic`."""
        if sys.platform == "win32":
            raise NotImplementedError
        remaining = until - time.monotonic()
        if remaining <= 0:
            return False
        if self._socket is None:
            time.sleep(min(RETRY_SECONDS, remaining))
            return True
        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        return bool(poller.poll(None if math.isinf(remaining) else math.ceil(remaining * 1000)))

    def _hear(self) -> None:
        """Connect unless connected, and take what the run has sent: rings, and the end."""
        if sys.platform == "win32":
            raise NotImplementedError
        if self._socket is None:
            self._connect()
        while self._socket is not None:
            try:
                data, descriptors, _, _ = sockets.recv_fds(self._socket, MAX_ANSWER_BYTES, MAX_RINGS_AT_ONCE)
            except BlockingIOError:
                return
            except ConnectionError:
                data, descriptors = b"", []
            for descriptor in descriptors:
                try:
                    self._rings.append(RingView(descriptor))
                finally:
                    os.close(descriptor)
            if data.startswith(REFUSAL):
                self._disconnect()
                raise StageError(f"{self._sensor}: {data[len(REFUSAL) :].decode()}")
            if not data:
                self._disconnect()

    def close(self) -> None:
        """Disconnect. Pictures that were read stay in memory, though a run that goes on overwrites them."""
        self._disconnect()
        self._rings.clear()
        self._last = 0

    def _disconnect(self) -> None:
        if self._socket is not None:
            with suppress(OSError):
                self._socket.close()
            self._socket = None

    def __iter__(self) -> Iterator[SharedPicture]:
        while True:
            yield self.read()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
