"""`tactflow start` with simulated cameras: questions answered on the page, in the terminal, or not at all."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml

from tactflow import open_scene
from tests.clock import until
from tests.program import Program


class Camera:
    """A network camera that shows a simulated gel: at rest, and pressed while `pressed` is set."""

    def __init__(self, scene: str) -> None:
        gel = open_scene(f"{scene}?frames=120")
        images = [cv2.resize(gel.frame(index), (400, 300)) for index in range(0, 60, 2)]
        self._jpegs = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1] for image in images]
        self.count = 0
        self.pressed, self._stopped = threading.Event(), threading.Event()
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                index = 0
                while not camera._stopped.wait(0.03):
                    index = index + 1 if camera.pressed.is_set() else 0
                    camera.count = index
                    jpeg = camera._jpegs[index % len(camera._jpegs)].tobytes()
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                    self.wfile.write(head.encode() + jpeg + b"\r\n")

            def log_message(self, format: str, *args: object) -> None:
                pass

        class Quiet(ThreadingHTTPServer):
            def handle_error(self, request: object, client_address: object) -> None:
                """A reader that hangs up is expected."""

        self._server = Quiet(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self._server.server_port}/stream"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()

    def press(self) -> None:
        """Press the gel twice, while somebody watches."""
        self.pressed.set()
        wanted = self.count + 2 * len(self._jpegs)
        until(lambda: self.count > wanted)

    def close(self) -> None:
        self._stopped.set()
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


@pytest.fixture
def camera() -> Iterator[Callable[[str], Camera]]:
    """Makes simulated cameras."""
    with ExitStack() as stack:
        yield lambda scene: stack.enter_context(closing(Camera(scene)))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Program]]:
    """Runs `tactflow start` in an empty folder."""
    with ExitStack() as stack:
        yield lambda *words: stack.enter_context(closing(Program("start", *words, cwd=tmp_path)))


def asked(page: Any, text: str) -> None:
    """Wait until the page asks."""
    page.wait_for_function(
        "text => document.getElementById('guide-now').textContent.includes(text)", arg=text
    )


def choose(page: Any, label: str) -> None:
    page.get_by_role("button", name=label, exact=True).click()


def test_a_sensor_is_set_up_on_the_page_and_goes_on_live(
    camera: Callable[[str], Camera],
    start: Callable[..., Program],
    open_page: Callable[..., Any],
    tmp_path: Path,
) -> None:
    gel = camera("press")
    running = start(gel.address)
    shown = open_page(running.said(r"on the page: (http\S+)"), lost=True)
    asked(shown, "Which sensor")
    choose(shown, "Another one, or unknown")
    asked(shown, "untouched")
    choose(shown, "Nothing touches the gel")
    asked(shown, "points away")
    choose(shown, "left edge")
    asked(shown, "several places")
    gel.press()
    choose(shown, "Done")
    asked(shown, "Proposed")
    written = tmp_path / "pipeline.yaml"
    assert not written.exists()
    choose(shown, "Write pipeline.yaml and go on live")
    shown.wait_for_function("() => document.body.dataset.asks === 'false'")
    shown.wait_for_function("() => document.getElementById('value-area').textContent !== '–'")
    running.process.send_signal(signal.SIGINT)
    assert running.exit_code() == 0, "".join(running.errors)
    assert not [line for line in running.errors if "the server failed" in line]
    pipeline = yaml.safe_load(written.read_text())
    assert pipeline["stages"]["capture"]["source"] == gel.address
    assert pipeline["stages"]["preprocess"]["rotate"] == 90
    assert "tracker" in pipeline["stages"]


def test_a_touch_at_rest_is_noticed_and_the_terminal_answers_as_the_page_does(
    camera: Callable[[str], Camera], start: Callable[..., Program], tmp_path: Path
) -> None:
    gel = camera("press")
    running = start(gel.address, "--no-run")
    running.said("Which sensor")
    running.type("1")
    running.said("Leave the gel untouched")
    gel.press()
    running.type("")
    running.said("The picture changed by [0-9]+ %, although nothing should touch the gel")
    gel.pressed.clear()
    until(lambda: gel.count == 0)
    running.type("9")
    running.said("required a number from 1 to 1; Enter is 1")
    running.type("1")
    # Frames of the press may still be under way.
    while running.said("(although nothing should touch|points away)") != "points away":
        running.type("1")
    running.type("2")
    running.said("several places")
    gel.press()
    running.type("1")
    running.said("Proposed: default: finds 100 % of the presses, 0 % false contacts at rest, 80 dots")
    running.said("2 Look again")
    running.type("2")
    gel.pressed.clear()
    running.said("Leave the gel untouched")
    running.process.send_signal(signal.SIGINT)
    assert running.exit_code() == 130
    running.said("stopped; nothing was written")
    assert list(tmp_path.iterdir()) == []
