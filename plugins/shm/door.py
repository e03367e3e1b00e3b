"""The socket at which readers ask for a port's ring, are handed its memory, and are woken for each picture.

A reader sends the name of the port and a line end. The writer answers with bytes: each wakes the reader, and
one of them comes with the descriptor of a ring (again where a larger one is needed), or with `!` and a
message it refuses. The end of the stream tells either side that the other has ended, however it did.
"""

from __future__ import annotations

import errno
import os
import re
import selectors
import socket
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

from tactflow.engine.errors import StageError
from tactflow.system.files import expanded, lock

from .layout import Picture, Ring

MAX_REQUEST_BYTES: Final = 256
"""Longest request of a reader, bytes: the name of a port."""
RETRY_SECONDS: Final = 0.1
"""Time until the next attempt to accept or to connect, s: short for a person, and little work."""
WAKE, RING, REFUSAL = b".", b"+", b"!"


def address_of(sensor: str, path: str | None) -> str | bytes:
    """The address of a sensor's socket: a file, or on Linux, without a path, a name that needs no file.

    Raises StageError on Windows.
    """
    if sys.platform == "win32":
        raise StageError(
            "shm: required Linux or macOS, got Windows; use the sink zmq with `pictures` instead"
        )
    if path is not None:
        return str(expanded(path))
    name = f"tactflow-{os.getuid()}-{sensor}"
    return f"\0{name}".encode() if sys.platform == "linux" else f"{tempfile.gettempdir()}/{name}.sock"


def may_talk(connection: socket.socket, address: str | bytes) -> bool:
    """Whether the process at the other end is ours or root's; for a file, its permissions decide."""
    if sys.platform != "linux" or isinstance(address, str):
        return True
    packed = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return struct.unpack("3i", packed)[1] in (0, os.getuid())


class _Reader:
    """A connected reader; its port is "" until it has asked for one."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.port = ""
        self.request = b""
        self.ring: Ring | None = None

    def wake(self, ring: Ring) -> None:
        """Tell of a picture; hand over the ring, if it has another. Never waits."""
        if sys.platform == "win32":
            raise NotImplementedError
        # A reader with a full queue wakes up anyhow. One that has ended is noticed by the thread.
        with suppress(OSError):
            if self.ring is ring:
                self.connection.send(WAKE)
            else:
                socket.send_fds(self.connection, [RING], [ring.descriptor])
                self.ring = ring


class Door:
    """Serves readers, in a thread of its own.

    address : as `address_of` returns. ports : that are offered. slots : of each ring.

    Raises
    ------
    StageError : another run uses the address, or it is not possible there.
    """

    def __init__(self, address: str | bytes, ports: Collection[str], slots: int) -> None:
        self._ports, self._slots, self._address = ports, slots, address
        self._readers: list[_Reader] = []
        self._rings: dict[str, Ring] = {}
        self._changed = threading.Condition()
        self._locked: int | None = None
        self._listener = self._bind()
        self._ending, self._end = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name="tactflow-shm", daemon=True)
        self._thread.start()

    def _bind(self) -> socket.socket:
        if sys.platform == "win32":
            raise NotImplementedError
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        shown = self._address if isinstance(self._address, str) else self._address[1:].decode()
        try:
            if isinstance(self._address, str):
                # A lock ends with its process, a socket's file does not.
                self._locked = os.open(f"{self._address}.lock", os.O_RDWR | os.O_CREAT, 0o600)
                if not lock(self._locked) or not os.path.samestat(
                    os.fstat(self._locked), os.stat(f"{self._address}.lock")
                ):
                    raise OSError("another run is using it")
                Path(self._address).unlink(missing_ok=True)
            listener.bind(self._address)
            if isinstance(self._address, str):
                os.chmod(self._address, 0o600)
            listener.listen()
        except OSError as error:
            listener.close()
            self._unlock(ours=False)
            used = "another run shares a sensor of this name; give each its own `sensor:`"
            reason = used if error.errno == errno.EADDRINUSE else error
            raise StageError(f"cannot share pictures at {shown}: {reason}") from error
        listener.setblocking(False)
        return listener

    def _unlock(self, *, ours: bool) -> None:
        if self._locked is not None and isinstance(self._address, str):
            for name in (self._address, f"{self._address}.lock") if ours else ():
                Path(name).unlink(missing_ok=True)
            os.close(self._locked)
            self._locked = None

    @property
    def wanted(self) -> Collection[str]:
        """The ports that have readers. Thread-safe."""
        return {reader.port for reader in tuple(self._readers)} - {""}

    @property
    def readers(self) -> int:
        """Number of readers of all ports. Thread-safe."""
        return sum(bool(reader.port) for reader in tuple(self._readers))

    def wait(self, seconds: float) -> bool:
        """Wait for a reader, at most `seconds`; returns whether there is one."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self.wanted), seconds)

    def publish(self, port: str, picture: Picture) -> None:
        """Write a picture into the ring of its port, and wake its readers. Never waits for one.

        Raises OSError if there is no memory.
        """
        with self._changed:
            if port not in self.wanted:
                return
            ring = self._rings.get(port)
            if ring is None or not ring.fits(picture):
                self._drop(port)
                ring = self._rings[port] = Ring(picture, self._slots)
        ring.write(picture)
        with self._changed:
            for reader in self._readers:
                if reader.port == port and self._rings.get(port) is ring:
                    reader.wake(ring)

    def _drop(self, port: str) -> None:
        ring = self._rings.pop(port, None)
        if ring is not None:
            ring.close()

    def _serve(self) -> None:
        """Body of the thread: accept readers, and notice when they end."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._listener, selectors.EVENT_READ)
            selector.register(self._ending, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    if key.fileobj is self._ending:
                        return
                    if isinstance(key.data, _Reader):
                        if not self._hear(key.data):
                            selector.unregister(key.fileobj)
                            self._leave(key.data)
                        continue
                    try:
                        connection, _ = self._listener.accept()
                    except OSError:
                        # Too many open files: the others go on.
                        time.sleep(RETRY_SECONDS)
                        continue
                    connection.setblocking(False)
                    reader = _Reader(connection)
                    with self._changed:
                        self._readers.append(reader)
                    selector.register(connection, selectors.EVENT_READ, reader)

    def _hear(self, reader: _Reader) -> bool:
        """Read a reader's request; False if it ends or is refused."""
        try:
            data = reader.connection.recv(MAX_REQUEST_BYTES)
        except BlockingIOError:
            return True
        except OSError:
            return False
        reader.request += b"" if reader.port else data
        if reader.port or b"\n" not in reader.request:
            return bool(data) and len(reader.request) < MAX_REQUEST_BYTES
        port = reader.request.partition(b"\n")[0].decode(errors="replace")
        problem = self._problem(reader, port)
        if problem:
            with suppress(OSError):
                reader.connection.send(REFUSAL + problem.encode())
            return False
        with self._changed:
            reader.port = port
            if port in self._rings:
                reader.wake(self._rings[port])
            self._changed.notify_all()
        return True

    def _problem(self, reader: _Reader, port: str) -> str | None:
        if not may_talk(reader.connection, self._address):
            return "this run belongs to another user"
        if port not in self._ports:
            shown = re.sub(r"\W", "?", port)
            offered = ", ".join(self._ports)
            return f"the port {shown} is not shared, but {offered}; list it in sinks.shm.ports"
        return None

    def _leave(self, reader: _Reader) -> None:
        """Forget a reader; without any, a port has no memory."""
        reader.connection.close()
        with self._changed:
            self._readers.remove(reader)
            reader.ring = None
            if reader.port not in self.wanted:
                self._drop(reader.port)

    def close(self) -> None:
        """Let the readers know of the end, and free the address."""
        self._end.send(b".")
        self._thread.join()
        with self._changed:
            readers: Sequence[_Reader] = tuple(self._readers)
            self._readers.clear()
            for reader in readers:
                reader.connection.close()
            for port in tuple(self._rings):
                self._drop(port)
        for one in (self._listener, self._ending, self._end):
            one.close()
        self._unlock(ours=True)
