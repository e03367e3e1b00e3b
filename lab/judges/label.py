"""A page on which a person labels frames of recordings: `python -m lab.judges.label RECORDING...`.

It is served to this machine only. Every change is saved at once, in the format of `label_file`.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2

from lab.judges.label_file import FrameLabel, load_labels, save_labels
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.sources import open_source
from tactflow.sources.files import ImageFiles
from tactflow.system.arguments import positive
from tactflow.system.terminal import say

HOST = "127.0.0.1"
TEXT = "text/plain; charset=utf-8"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; script-src 'unsafe-inline'; "
    "style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True, slots=True)
class Item:
    """A frame to label. recording, frame, reference : as in `FrameLabel`. The pictures are PNG files."""

    recording: str
    frame: int | str
    reference: int | str
    picture: bytes
    reference_picture: bytes


def read_items(
    spec: str, recording: str, reference: str | None = None, frames: Sequence[str] = (), every: int = 1
) -> list[Item]:
    """Read the frames of a recording that are to be labelled.

    spec : what `open_source` takes, except cameras and streams. recording : its name in the labels.
    reference : the untouched gel: the name of a picture without its suffix, or an index; None: the first
    frame. frames : which to label, by name or index; empty: every `every`-th one except the reference.

    Raises ConfigError if there is no such frame, or it is not a recording, SourceError if it cannot be read.
    """
    with closing(open_source(spec)) as reader:
        if reader.live:
            raise ConfigError(f"{spec}: required a recording, not a camera or a stream")
        names = [file.stem for file in reader.files] if isinstance(reader, ImageFiles) else []
        if len(set(names)) < len(names):
            raise ConfigError(f"{spec}: two pictures have the same name without their suffix; rename one")
        base = 0 if reference is None else _index(reference, names, spec)
        chosen = {_index(text, names, spec) for text in frames}
        kept: dict[int, bytes] = {}
        index = 0
        while (read := reader.read()) is not None:
            if index == base or (index in chosen if chosen else index % every == 0):
                kept[index] = cv2.imencode(".png", read[0], [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
            index += 1
    if missing := sorted({base, *chosen} - kept.keys()):
        raise ConfigError(f"{spec}: has no frame {missing[0]}; it has {index} frames, counted from 0")
    called = names or range(index)
    return [
        Item(recording, called[number], called[base], kept[number], kept[base])
        for number in sorted(chosen or kept.keys() - {base})
    ]


def _index(text: str, names: Sequence[str], spec: str) -> int:
    if text not in names and not text.isdecimal():
        raise ConfigError(f"{spec}: no frame {text!r}; required the name of a picture, or an index from 0")
    return names.index(text) if text in names else int(text)


class LabelServer(ThreadingHTTPServer):
    """Serves the page for these items; `serve_forever` runs it, and `address` is where.

    path : the file of labels, created if missing. lab, round_ : of the labels; those of other rounds are
    neither shown nor changed. dots : clicks mark dots instead of outlines.

    Raises ConfigError if the file of labels is broken.
    """

    def __init__(
        self,
        items: Sequence[Item],
        path: Path,
        lab: str = "",
        round_: int = 1,
        dots: bool = False,
    ) -> None:
        self.path = path
        frames = [{"recording": i.recording, "frame": i.frame, "reference": i.reference} for i in items]
        self._overview = {"frames": frames, "lab": lab, "round": round_, "dots": dots}
        page, look = Path(__file__).with_name("label.html"), files("tactflow.view") / "page"
        self.content = {
            "/": ("text/html; charset=utf-8", page.read_bytes()),
            "/style.css": ("text/css", (look / "style.css").read_bytes()),
            "/icon.svg": ("image/svg+xml", (look / "icon.svg").read_bytes()),
        }
        for number, item in enumerate(items):
            self.content[f"/frames/{number}/picture"] = "image/png", item.picture
            self.content[f"/frames/{number}/reference"] = "image/png", item.reference_picture
        self._saving = threading.Lock()
        self.overview()
        super().__init__((HOST, 0), _Handler)
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}
        self.address = f"http://{HOST}:{self.server_port}/"

    def overview(self) -> bytes:
        """What the page shows, as JSON: the items, and the labels of this round in the file."""
        labels = [label.model_dump() for label in self._load() if label.round == self._overview["round"]]
        return json.dumps({**self._overview, "labels": labels}).encode()

    def change(self, label: FrameLabel, remove: bool) -> None:
        """Replace the label of the same frame and round, or remove it; all else in the file stays.

        Raises ConfigError or StageError if the file of labels is broken by now, or cannot be written.
        """
        with self._saving:
            # Another page or program may have changed it.
            labels = self._load()
            place = next((i for i, other in enumerate(labels) if other.key == label.key), len(labels))
            labels[place : place + 1] = [] if remove else [label]
            save_labels(self.path, labels)

    def _load(self) -> list[FrameLabel]:
        return load_labels(self.path) if self.path.exists() else []


class _Handler(BaseHTTPRequestHandler):
    """One request: the page, the overview, a picture, or a label to store (POST) or to remove (DELETE)."""

    server: LabelServer

    def do_GET(self) -> None:
        """Answer a request."""
        try:
            status, kind, body = self._answer()
        except ValueError as error:
            status, kind, body = HTTPStatus.BAD_REQUEST, TEXT, f"not a label: {error}".encode()
        except TactflowError as error:
            status, kind, body = HTTPStatus.INTERNAL_SERVER_ERROR, TEXT, str(error).encode()
        self.send_response(status)
        for name, value in (HEADERS | {"Content-Type": kind, "Content-Length": str(len(body))}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    do_POST = do_DELETE = do_GET  # noqa: N815

    def _answer(self) -> tuple[HTTPStatus, str, bytes]:
        host = self.headers["Host"]
        if host not in self.server.hosts:
            return HTTPStatus.MISDIRECTED_REQUEST, TEXT, b"open the address that was printed"
        if self.command == "GET" and self.path == "/frames":
            return HTTPStatus.OK, "application/json", self.server.overview()
        if self.command == "GET":
            found = self.server.content.get(self.path)
            return (HTTPStatus.OK, *found) if found else (HTTPStatus.NOT_FOUND, TEXT, b"no such page")
        # Other web sites that the browser shows may send requests here, but not with this origin.
        if self.headers["Origin"] != f"http://{host}":
            return HTTPStatus.FORBIDDEN, TEXT, b"foreign origin"
        label = FrameLabel.model_validate_json(self.rfile.read(int(self.headers["Content-Length"] or 0)))
        self.server.change(label, remove=self.command == "DELETE")
        return HTTPStatus.OK, TEXT, b"saved"

    def log_message(self, *_: Any) -> None:
        """Requests are not logged."""


def _items(args: argparse.Namespace) -> list[Item]:
    """The frames of all recordings, in the order in which they are shown."""
    items: list[Item] = []
    names = set()
    for spec in args.recordings:
        try:
            path = Path(spec)
            name = path.resolve().relative_to(args.root.resolve()).as_posix() if args.root else path.name
        except ValueError:
            raise ConfigError(f"--root {args.root}: {spec} is not in this folder") from None
        if name in names:
            raise ConfigError(f"{spec}: two recordings have this name; give --root, a folder that holds both")
        names.add(name)
        frames = args.frames.split(",") if args.frames else ()
        items += read_items(spec, name, args.reference, frames, args.every)
    if not items:
        raise ConfigError("no frame to label; give a smaller --every, or --frames")
    return items


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve the page until Ctrl-C; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab.judges.label", description=__doc__)
    add, which = parser.add_argument, parser.add_mutually_exclusive_group().add_argument
    add("recordings", nargs="+", metavar="RECORDING", help="a folder of pictures, a video, ...")
    add("--labels", type=Path, required=True, metavar="FILE", help="JSON file to read and write")
    which("--every", type=positive, default=10, metavar="N", help="every Nth frame (default: 10)")
    which("--frames", metavar="A,B,...", help="these: names of pictures without suffix, or indices from 0")
    add("--reference", metavar="FRAME", help="the untouched gel, as in --frames (default: the first frame)")
    add("--dots", action="store_true", help="clicks mark dots instead of outlines")
    add("--root", type=Path, metavar="DIR", help="store paths of recordings relative to DIR")
    add("--lab", default="", metavar="NAME", help="stored with each label")
    add("--round", type=positive, default=1, metavar="N", help="2: label again, without a look at 1")
    args = parser.parse_args(arguments)
    try:
        items = _items(args)
        server = LabelServer(items, args.labels, args.lab, args.round, args.dots)
    except TactflowError as error:
        say(f"tactflow: {error}")
        return error.exit_code
    print(f"tactflow: {len(items)} frames to label at {server.address} (Ctrl-C ends)", flush=True)
    with server, suppress(KeyboardInterrupt):
        server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(main())
