"""Streams on loopback, served by ffmpeg."""

from __future__ import annotations

import shutil
import signal
import socket
import subprocess

FFMPEG = shutil.which("ffmpeg")

MOVING = "testsrc2=size=320x240:rate=30"
TURNS = 40
"""How often a picture stands still: who is late for one time sees the next."""
FREEZES = (
    "".join(
        f"testsrc2=size=320x240:rate=30:duration=3[moves{n}];"
        f"color=gray:size=320x240:rate=30:duration=4[stands{n}];"
        for n in range(TURNS)
    )
    + "".join(f"[moves{n}][stands{n}]" for n in range(TURNS))
    + f"concat=n={2 * TURNS}"
)
DARKENS = FREEZES.replace("color=gray", "color=black")


class Server:
    """A stream that comes and goes; `address` stays the same.

    kind : "http" (motion JPEG) or "udp" (MPEG-2 in an MPEG transport stream). picture : a graph of
        ffmpeg's lavfi.
    """

    def __init__(self, kind: str, picture: str = MOVING) -> None:
        self._kind = kind
        self._picture = picture
        with socket.socket(
            socket.AF_INET, socket.SOCK_DGRAM if kind == "udp" else socket.SOCK_STREAM
        ) as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.address = f"{kind}://127.0.0.1:{port}"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        assert FFMPEG is not None
        out = {
            "http": ["-c:v", "mjpeg", "-f", "mpjpeg", "-listen", "1", self.address],
            "udp": ["-c:v", "mpeg2video", "-g", "10", "-f", "mpegts", f"{self.address}?pkt_size=1316"],
        }[self._kind]
        self._process = subprocess.Popen(
            [FFMPEG, "-nostdin", "-loglevel", "quiet", "-re", "-f", "lavfi", "-i", self._picture, *out],
            stdin=subprocess.DEVNULL,
        )

    def kill(self) -> None:
        """End it without a goodbye."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def halt(self) -> None:
        """Let it fall silent; its connections stay open."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)
