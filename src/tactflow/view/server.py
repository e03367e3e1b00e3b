"""HTTP and WebSocket server of the live view, in its own thread.

Serves a few fixed files and a WebSocket. Rejects requests for foreign host names (DNS rebinding), WebSockets
from other origins, and, if a token is set, WebSockets without it.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import logging
import re
import socket
import threading
from importlib import resources
from urllib.parse import parse_qs, urlsplit

import uvicorn
from h11 import LocalProtocolError
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket
from uvicorn.protocols.http.h11_impl import H11Protocol

from tactflow.view.address import LOOPBACK_NAMES, WILDCARDS, bracketed
from tactflow.view.hub import MAX_PAGES, Hub

log = logging.getLogger("tactflow")

HOST_HEADER = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?")

START_SECONDS = 10.0
CLOSE_SECONDS = 3.0
"""Timeouts for starting and stopping the server, s."""

MAX_CONNECTIONS = 128
"""Maximum number of connections; further ones are answered with 503. Each page opens up to seven."""

WRONG_TOKEN = 4401
TOO_MANY = 4429
"""WebSocket close codes, because a page cannot read the reason for a rejected handshake. Codes from 4000 are
for private use (RFC 6455, 7.4.2); the last digits follow HTTP 401 and 429."""

TYPES = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


class _Connection(H11Protocol):
    """An HTTP connection that handles malformed HEAD requests, for which h11 rejects an error page."""

    def send_400_response(self, msg: str) -> None:
        """Answer 400 Bad Request and close the connection."""
        with contextlib.suppress(LocalProtocolError):
            super().send_400_response(msg)
        self.transport.close()


class Server:
    """Serves the page and the hub's messages on a listening socket, which it owns.

    host : configured name or address; requests must address it or loopback. token : required of pages; None
    admits all pages of this origin.
    """

    def __init__(self, hub: Hub, listener: socket.socket, host: str, token: str | None) -> None:
        self.hub = hub
        self.token = token
        self._listener = listener
        self._files = _load_files()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ready = threading.Event()
        app = Starlette(
            routes=[WebSocketRoute("/live", self._live), Route("/{path:path}", self._file, methods=["GET"])]
        )
        config = uvicorn.Config(
            _Guard(app, host),
            loop="asyncio",
            http=_Connection,
            ws="websockets-sansio",
            # Commands are short; pictures are already compressed.
            ws_max_size=4096,
            ws_per_message_deflate=False,
            limit_concurrency=MAX_CONNECTIONS,
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="tactflow-view-server", daemon=True)

    def start(self) -> None:
        """Start serving; returns once requests are answered."""
        self._thread.start()
        self._ready.wait(START_SECONDS)

    def close(self) -> None:
        """Notify the pages of the end of the run and stop serving, within `CLOSE_SECONDS`."""
        loop = self._loop
        if loop is not None and self._thread.is_alive():
            try:
                asyncio.run_coroutine_threadsafe(self._end(), loop)
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
        self._loop = asyncio.get_running_loop()
        self.hub.attach(self._loop)
        self._ready.set()
        reporter = asyncio.create_task(self._report())
        try:
            await self._server.serve(sockets=[self._listener])
        finally:
            reporter.cancel()
            # A page that does not read would keep its connection open forever.
            for connection in list(self._server.server_state.connections):
                transport = getattr(connection, "transport", None)
                if transport is not None:
                    transport.abort()
            await asyncio.sleep(0)

    async def _report(self) -> None:
        try:
            await self.hub.report()
        except Exception as error:
            log.warning("view: the statistics failed: %s: %s", type(error).__name__, error)

    async def _end(self) -> None:
        self.hub.end()
        # Give pages half a second to read the last message.
        for _ in range(25):
            if not self.hub.pages:
                break
            await asyncio.sleep(0.02)
        self._server.should_exit = True

    async def _file(self, request: Request) -> Response:
        name = request.path_params["path"] or "index.html"
        content = self._files.get(name)
        if content is None:
            return PlainTextResponse("no such page\n", 404)
        return Response(content, media_type=TYPES[name.rpartition(".")[2]])

    async def _live(self, websocket: WebSocket) -> None:
        if not _same_origin(websocket.headers):
            await websocket.close(1008)
            return
        await websocket.accept()
        if not self._admits(websocket):
            # Slow down brute-force attacks.
            await asyncio.sleep(0.5)
            await websocket.close(WRONG_TOKEN, "token required")
        elif len(self.hub.pages) >= MAX_PAGES:
            await websocket.close(TOO_MANY, f"more than {MAX_PAGES} pages are open")
        else:
            await self.hub.serve(websocket)

    def _admits(self, websocket: WebSocket) -> bool:
        if self.token is None:
            return True
        token = parse_qs(websocket.url.query).get("token", [""])[0]
        return hmac.compare_digest(token.encode(), self.token.encode())


class _Guard:
    """Reject requests for foreign host names, and add security headers to every response."""

    def __init__(self, app: ASGIApp, host: str) -> None:
        self._app = app
        wildcard = host in WILDCARDS
        # On a wildcard address the valid names are unknown; a token is required instead.
        self._names = None if wildcard else LOOPBACK_NAMES | {bracketed(host).lower()}

    def _is_ours(self, host: str) -> bool:
        # The header is copied into the policy below, so it must be a plain name and port.
        parts = HOST_HEADER.fullmatch(host)
        return parts is not None and (self._names is None or parts[1].lower() in self._names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host = Headers(scope=scope).get("host", "")
        if not self._is_ours(host):
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                text = "unknown host name; open the address that tactflow printed\n"
                await PlainTextResponse(text, 421)(scope, receive, send)
            return
        policy = (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
            f"connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
            "frame-ancestors 'none'"
        )
        added = [
            (b"content-security-policy", policy.encode("latin-1")),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"cross-origin-opener-policy", b"same-origin"),
            (b"cache-control", b"no-store"),
        ]

        async def send_guarded(message: object) -> None:
            assert isinstance(message, dict)
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *added]
            await send(message)

        await self._app(scope, receive, send_guarded)


def _load_files() -> dict[str, bytes]:
    """Read all files of the page, so that requests do not access the file system."""
    folder = resources.files("tactflow.view") / "page"
    return {
        item.name: item.read_bytes()
        for item in folder.iterdir()
        if item.name.rpartition(".")[2] in TYPES and item.is_file()
    }


def _same_origin(headers: Headers) -> bool:
    """Whether a WebSocket was opened by our page, according to its Origin header."""
    origin, host = headers.get("origin", ""), headers.get("host", "")
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    return parts.scheme in ("http", "https") and parts.netloc.lower() == host.lower() != ""
