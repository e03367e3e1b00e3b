"""HTTP and WebSocket server of the live view, in its own thread.

Serves a few fixed files and a WebSocket. Rejects requests for foreign host names (DNS rebinding), WebSockets
from other origins, and, if a token is set, WebSockets without it.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
import socket
import threading
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit
from weakref import WeakSet

from websockets.asyncio.server import ServerConnection, serve
from websockets.http11 import Request, Response

from tactflow.view.address import LOOPBACK_NAMES, WILDCARDS, bracketed
from tactflow.view.hub import Hub

log = logging.getLogger("tactflow")

HOST_HEADER = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?")

START_SECONDS = 10.0
CLOSE_SECONDS = 3.0
"""Timeouts for starting and stopping the server, s."""

WRONG_TOKEN = 4401
"""WebSocket close code, because a page cannot read the reason for a rejected handshake. Codes from 4000 are
for private use (RFC 6455, 7.4.2); the last digits follow HTTP 401."""

TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


class Server:
    """Serves the page and the hub's messages on a listening socket, which it owns.

    Parameters
    ----------
    host : configured name or address; requests must address it or loopback.
    token : required of pages; None admits all pages of this origin.
    """

    def __init__(self, hub: Hub, listener: socket.socket, host: str, token: str | None) -> None:
        self.hub = hub
        self.token = token
        self._listener = listener
        # On a wildcard address the valid names are unknown; a token is required instead.
        self._names = None if host in WILDCARDS else LOOPBACK_NAMES | {bracketed(host).lower()}
        self._files = _load_files()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop = asyncio.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tactflow-view-server", daemon=True)

    def start(self) -> None:
        """Start serving; returns once requests are answered."""
        self._thread.start()
        self._ready.wait(START_SECONDS)

    def close(self) -> None:
        """Notify the pages of the end of the run and stop serving, within `CLOSE_SECONDS`."""
        if self._loop is not None and self._thread.is_alive():
            try:
                self._loop.call_soon_threadsafe(self._stop.set)
            except RuntimeError:
                # The loop has just closed.
                return
            self._thread.join(CLOSE_SECONDS)
            if self._thread.is_alive():
                log.warning("view: the server did not stop within %g s; abandoning it", CLOSE_SECONDS)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:
            log.warning("view: the server failed: %s: %s", type(error).__name__, error)
        finally:
            self._listener.close()
            self._ready.set()

    async def _serve(self) -> None:
        self._loop = self.hub.loop = asyncio.get_running_loop()
        connections: WeakSet[ServerConnection] = WeakSet()

        def connect(*words: Any, **named: Any) -> ServerConnection:
            connection = ServerConnection(*words, **named)
            connections.add(connection)
            return connection

        # Invalid requests concern only their senders.
        quiet = logging.getLogger("tactflow.view.websockets")
        quiet.setLevel(logging.CRITICAL + 1)
        async with serve(
            self._live,
            sock=self._listener,
            process_request=self._answer,
            create_connection=connect,  # type: ignore[arg-type]
            # Commands are short; pictures are already compressed.
            max_size=4096,
            compression=None,
            close_timeout=1,
            server_header=None,
            logger=quiet,
        ):
            self._ready.set()
            reporter = asyncio.create_task(self.hub.report())
            await self._stop.wait()
            reporter.cancel()
            self.hub.end()
            # Give pages half a second to read the last message.
            for _ in range(25):
                if not self.hub.pages:
                    break
                await asyncio.sleep(0.02)
            # Clients that neither read nor send a request would keep their connections open.
            for connection in connections:
                connection.transport.abort()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The response to a request for a file; None admits a WebSocket."""
        host = "".join(request.headers.get_all("Host"))
        path = request.path.partition("?")[0]
        upgrade = path == "/live" and "Upgrade" in request.headers
        # The header is copied into the policy below, so it must be a plain name and port.
        parts = HOST_HEADER.fullmatch(host)
        if parts is None or (self._names is not None and parts[1].lower() not in self._names):
            text = "unknown host name; open the address that tactflow printed\n"
            return connection.respond(403 if upgrade else 421, text)
        if upgrade:
            origin = "".join(request.headers.get_all("Origin"))
            return None if _same_origin(origin, host) else connection.respond(403, "foreign origin\n")
        name = path[1:] or "index.html"
        found = name in self._files
        response = connection.respond(200 if found else 404, self._files.get(name, "no such page\n"))
        if found:
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = TYPES[name.rpartition(".")[2]]
        response.headers["Content-Security-Policy"] = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
            f"connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
        response.headers["Cross-Origin-Opener-Policy"] = "same-origin"
        response.headers["Cache-Control"] = "no-store"
        return response

    async def _live(self, connection: ServerConnection) -> None:
        if not self._admits(connection):
            # Slow down brute-force attacks.
            await asyncio.sleep(0.5)
            await connection.close(WRONG_TOKEN, "token required")
        else:
            await self.hub.serve(connection)

    def _admits(self, connection: ServerConnection) -> bool:
        if self.token is None or connection.request is None:
            return self.token is None
        token = parse_qs(connection.request.path.partition("?")[2]).get("token", [""])[0]
        return hmac.compare_digest(token.encode(), self.token.encode())


def _load_files() -> dict[str, str]:
    """Read all files of the page, so that requests do not access the file system."""
    folder = resources.files("tactflow.view") / "page"
    return {
        item.name: item.read_text(encoding="utf-8")
        for item in folder.iterdir()
        if item.name.rpartition(".")[2] in TYPES and item.is_file()
    }


def _same_origin(origin: str, host: str) -> bool:
    """Whether a WebSocket was opened by our page, according to its Origin header."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower()
