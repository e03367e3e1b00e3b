"""The view's page in a real browser: headless Chromium, driven by Playwright.

Screenshots go to the folder named by TACTFLOW_SCREENSHOTS, else to a temporary one. With that set, they show
plots that are full: `TACTFLOW_SCREENSHOTS=out pytest tests/browser -k fits`.
"""

from __future__ import annotations

import json
import os
import re
import signal
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from http import HTTPStatus
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection
from websockets.sync.server import serve as websockets_serve

from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.view.compact import encode_packet
from tactflow.vision.types import Contact, Ellipse, Flow, Markers
from tests.chromium import CHROMIUM, FLAGS, PATIENCE
from tests.program import Program

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = REPOSITORY / "src" / "tactflow" / "view" / "page"
ENDLESS = "sim:twist?frames=100000"

DRAWN = """() => ['area', 'angle', 'flow'].every(
    name => document.getElementById('value-' + name).textContent !== '–')"""
"""A contact, its direction and its flow are shown."""


class Run(Program):
    """A run in a process of its own, and the address of its page."""

    def __init__(self, *options: str, cwd: Path = REPOSITORY, port: int = 0) -> None:
        shipped = ("--set", "sinks.zmq=null", "--set", "sinks.jsonl=null") if cwd == REPOSITORY else ()
        view = ("--set", f"sinks.view={{use: view, port: {port}, max_fps: 10}}")
        super().__init__("run", "pipeline.yaml", *shipped, *view, *options, cwd=cwd)
        self.url = self.said(r"view: (http://\S+)")

    @property
    def port(self) -> int:
        return int(self.url.rstrip("/").rpartition(":")[2])


@pytest.fixture
def run() -> Iterator[Callable[..., Run]]:
    """Starts runs; what is left of them is ended after the test."""
    with ExitStack() as stack:
        yield lambda *words, **options: stack.enter_context(closing(Run(*words, **options)))


@pytest.fixture(scope="module")
def watched() -> Iterator[Run]:
    """A run for the tests that leave it as they found it."""
    started = Run("--realtime", "--source", ENDLESS)
    yield started
    started.close()


@pytest.fixture(scope="module")
def browser_without_webgl(browser: Any) -> Iterator[Any]:
    """One that cannot draw in three dimensions."""
    flat = browser.browser_type.launch(
        executable_path=CHROMIUM, args=[*FLAGS, "--disable-software-rasterizer"], timeout=PATIENCE
    )
    yield flat
    flat.close()


@pytest.fixture(scope="module")
def screenshots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pictures of the page go."""
    folder = os.environ.get("TACTFLOW_SCREENSHOTS")
    path = Path(folder) if folder else tmp_path_factory.mktemp("screenshots")
    path.mkdir(parents=True, exist_ok=True)
    return path


def until(page: Any, condition: str, argument: Any = None) -> None:
    """Wait until a JavaScript expression holds."""
    page.wait_for_function(condition, arg=argument)


def status(page: Any, wanted: str) -> None:
    """Wait until the page is in a state."""
    until(page, "wanted => document.body.dataset.status === wanted", wanted)


def seq(page: Any) -> int:
    """The frame that is shown."""
    return int(page.get_attribute("#picture", "data-seq"))


def pixels(page: Any, canvas: str) -> bytes:
    """What a canvas shows. A worker draws it, so a screenshot is the only way to see it."""
    return bytes(page.locator(f"#{canvas}").screenshot())


def shows(page: Any, canvas: str, condition: Callable[[bytes], bool]) -> bool:
    """Whether a canvas comes to show what is wanted: drawing takes the worker a moment."""
    deadline = time.monotonic() + PATIENCE / 1000
    while not condition(pixels(page, canvas)):
        if time.monotonic() > deadline:
            return False
    return True


def steady(page: Any, canvas: str) -> bytes:
    """What a canvas shows once it no longer changes."""
    before = b""
    while before != (now := pixels(page, canvas)):
        before = now
        page.wait_for_timeout(100)
    return now


def advance(page: Any, frames: int = 1) -> None:
    """Wait until later frames are shown."""
    until(page, "seq => Number(document.getElementById('picture').dataset.seq) >= seq", seq(page) + frames)


def watch(page: Any) -> None:
    """Wait for the first frame."""
    status(page, "live")
    until(page, "() => document.getElementById('picture').dataset.seq !== undefined")


def pause_in_contact(page: Any) -> None:
    """Hold the run at a frame that shows everything there is to draw."""
    for _ in range(20):
        until(page, DRAWN)
        page.click("#pause")
        status(page, "paused")
        settled(page)
        if page.evaluate(DRAWN):
            return
        page.click("#pause")
        status(page, "live")
    raise AssertionError("no frame with a contact, a direction and flow could be held")


def settled(page: Any) -> None:
    """Wait until the frames that were under way are shown."""
    before = -1
    while before != (now := seq(page)):
        before = now
        page.wait_for_timeout(300)


def test_a_page_finds_the_run_again_after_a_restart(
    run: Callable[..., Run], open_page: Callable[..., Any], screenshots: Path
) -> None:
    first = run("--realtime", "--source", ENDLESS)
    page = open_page(first.url, lost=True)
    watch(page)
    advance(page, 20)
    first.process.send_signal(signal.SIGKILL)
    first.exit_code()
    status(page, "disconnected")
    assert "Next attempt" in page.inner_text("#empty-text")
    page.screenshot(path=screenshots / "view-disconnected.png")
    second = run("--realtime", "--source", "sim:slide?frames=100000", port=first.port)
    assert second.url == first.url
    watch(page)
    until(page, "() => document.getElementById('source').textContent.startsWith('sim:slide')")
    advance(page, 5)


def test_sensors_of_several_processes_share_their_tabs(
    run: Callable[..., Run], open_page: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "pipeline.yaml").write_text(
        "sensors:\n"
        f"  left: {{stages: {{capture: {{source: '{ENDLESS}', realtime: true}}}}}}\n"
        "  right: {stages: {capture: {source: 'sim:idle?frames=100000', realtime: true}}}\n"
        f"stages:\n  capture: {{source: '{ENDLESS}'}}\n  preprocess: {{downsample: 2}}\n"
        "sinks:\n  view: {}\n"
    )
    started = run(cwd=tmp_path)
    page = open_page(started.url, everywhere=True, lost=True)
    watch(page)
    until(page, "() => document.getElementById('tabs').innerText.split(/\\s+/).join() === 'left,right'")
    for sensor, source in (("right", "sim:idle"), ("left", "sim:twist")):
        page.click(f"#tabs >> text={sensor}")
        until(page, "s => document.querySelector('#tabs [aria-selected=true]')?.textContent === s", sensor)
        watch(page)
        assert page.inner_text("#source").startswith(source)
    started.process.send_signal(signal.SIGTERM)
    assert started.exit_code() == 0
    status(page, "ended")


def test_a_token_is_asked_for_and_leaves_the_address(
    run: Callable[..., Run], open_page: Callable[..., Any]
) -> None:
    secret = "a-secret-of-some-length"
    started = run("--realtime", "--source", ENDLESS, "--set", f"sinks.view.token={secret}")
    assert started.url.endswith(f"?token={secret}")
    address = started.url.partition("?")[0]
    page = open_page(address)
    status(page, "token")
    page.fill("#token", "a-wrong-one")
    page.keyboard.press("Enter")
    status(page, "token")
    page.fill("#token", secret)
    page.keyboard.press("Enter")
    watch(page)
    other = open_page(address)
    other.goto(started.url)
    watch(other)
    assert secret not in other.url


# -- a server of the test's own -----------------------------------------------------------------------------


class Stage:
    """Serves the page's files, and plays the run: what it says and hears is up to the test.

    greet : what to send a page that connects.
    """

    def __init__(self, *greet: str | bytes) -> None:
        self.greet = greet
        self.heard: list[Any] = []
        self.page: ServerConnection | None = None
        self._server = websockets_serve(
            self._play, "127.0.0.1", 0, process_request=self._file, compression=None
        )
        self.url = f"http://127.0.0.1:{self._server.socket.getsockname()[1]}/"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def _file(self, connection: ServerConnection, request: Request) -> Response | None:
        name = request.path.strip("/") or "index.html"
        if name == "live":
            return None
        kinds = {"html": "text/html", "js": "text/javascript", "css": "text/css", "svg": "image/svg+xml"}
        response = connection.respond(HTTPStatus.OK, (PAGE / name).read_text())
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = kinds[name.rpartition(".")[2]]
        return response

    def _play(self, connection: ServerConnection) -> None:
        for message in self.greet:
            connection.send(message)
        self.page = connection
        for text in connection:
            self.heard.append(json.loads(text))

    def send(self, message: str | bytes) -> None:
        assert self.page is not None
        self.page.send(message)

    def close(self) -> None:
        if self.page is not None:
            self.page.close()
        self._server.shutdown()
        self._thread.join()


@pytest.fixture
def staged() -> Iterator[Callable[..., Stage]]:
    """Opens servers of the test's own."""
    with ExitStack() as stack:
        yield lambda *greet: stack.enter_context(closing(Stage(*greet)))


def frame(sensor: str, number: int, colour: int, *, contact: bool = False, directed: bool = False) -> bytes:
    """A frame as the view sends it."""
    origin = np.array([[10.0, 10], [30, 10], [50, 20]])
    values: dict[str, Any] = {
        "markers": Markers(
            origin, origin + np.array([3, 2]), np.arange(3, dtype=np.uint8), np.full(3, np.nan)
        )
    }
    if contact:
        hull = np.array([[20.0, 10], [40, 10], [30, 30]])
        ellipse = Ellipse((30.0, 20.0), (30.0, 12.0), -30.0) if directed else None
        angle = -30.0 if directed else None
        values["contact"] = Contact(300.0, (30.0, 20.0), angle, None, hull, ellipse)
        values["flow"] = Flow((4.0, -2.0), 3) if directed else Flow(None, 0)
    result = Result(Frame(sensor, number, number / 30, np.full((40, 60, 3), colour, np.uint8)), values, {})
    options: dict[str, Any] = {"latency_ms": 3.0, "guide": None, "quality": 95, "max_size": 1280}
    header, jpeg = encode_packet(result, None, **options)
    header += b',"number":%d}' % number
    return struct.pack("<I", len(header)) + header + jpeg


def with_header(packet: bytes, heights: bytes = b"", **added: Any) -> bytes:
    """A frame as the view sends it, with more in its header."""
    length = struct.unpack_from("<I", packet)[0]
    header = json.dumps(json.loads(packet[4 : 4 + length]) | added).encode()
    return struct.pack("<I", len(header)) + header + heights + packet[4 + length :]


def calibrated(
    number: int, *, slipping: bool = False, height: float = 0.5, in_range: bool = True, **force: Any
) -> bytes:
    """A frame of a calibrated sensor with all that the page can show."""
    plain = frame("main", number, 120, contact=True, directed=True)
    length = struct.unpack_from("<I", plain)[0]
    header = json.loads(plain[4 : 4 + length])
    message = header["message"]
    message["contact"] |= {"area_mm2": 3.0, "center_mm": [0.1, -0.2], "depth_mm": height}
    message["contact"] |= {"depth_mm_stderr": 0.01, "volume_mm3": 0.7}
    message["flow"] |= {"stderr": [0.3, 0.4], "mean_mm": [0.4, -0.2], "mean_mm_stderr": [0.03, 0.04]}
    message["slip"] = {"slipping": slipping, "stick_ratio": 0.0 if slipping else 0.8}
    message["slip"] |= {"translation": [3.0, 4.0], "translation_mm": [0.3, 0.4], "rotation": 5.0}
    message["force"] = {"value": [None, None, 2.5], "stderr": [None, None, 0.2], "in_range": in_range} | force
    message["pose"] = {
        "status": "tracked",
        "since": 1,
        "center": [0.1, -0.2, -0.4],
        "translation": [0.3, 0, 0.4],
    }
    message["pose"] |= {"rotation": [0, 3, 4], "stderr": [0.01, 0.02, 0.01, 0.2, 0.3, 57.0]}
    y, x = np.mgrid[-1:1:16j, -1:1:20j]
    heights = np.rint(np.maximum(0, 1 - x**2 - y**2) * 65535).astype("<u2").tobytes()
    surface = {"box": [20, 10, 20, 16], "size": [20, 16], "step": height / 65535, "bytes": len(heights)}
    field = header["markers"] | {"status": "iii"}
    return with_header(plain, heights, message=message, scale=[0.1, 0.1], field=field, surface=surface)


def state(sensor: str, **changes: Any) -> str:
    """A state as the view sends it."""
    names = ("pause", "step", "reference", "record", "stop")
    source = {"description": f"camera of {sensor}", "live": True, "total": None, "state": "connected"}
    whole = {
        **{"type": "state", "sensor": sensor, "paused": False, "recording": False, "end": None},
        **{"neighbours": {}, "source": source, "refused": dict.fromkeys(names)},
    }
    return json.dumps(whole | changes)


def hello(*sensors: str) -> str:
    """How a run greets a page."""
    return json.dumps({"type": "hello", "run": "1", "sensors": sensors})


def test_each_layer_is_drawn_and_can_be_hidden(
    staged: Callable[..., Stage], open_page: Callable[..., Any]
) -> None:
    stage = staged(hello("main"), state("main"), frame("main", 1, 120, contact=True, directed=True))
    page = open_page(stage.url)
    watch(page)
    until(page, "() => document.getElementById('value-angle').textContent === '−30.0°'")
    assert page.get_attribute("#layer-ellipse", "aria-pressed") == "false"
    without = steady(page, "picture")
    page.click("#layer-ellipse")
    assert shows(page, "picture", lambda seen: seen != without)
    whole = steady(page, "picture")
    for key, layer in enumerate(("image", "arrows", "hull", "axis", "ellipse", "mean"), start=1):
        page.click(f"#layer-{layer}")
        assert page.get_attribute(f"#layer-{layer}", "aria-pressed") == "false"
        assert shows(page, "picture", lambda seen: seen != whole), layer
        page.keyboard.press(str(key))
        assert page.get_attribute(f"#layer-{layer}", "aria-pressed") == "true"
        assert shows(page, "picture", lambda seen: seen == whole), layer
    page.keyboard.press("x")
    assert page.inner_text("#magnify span") == "Arrows × 5"
    assert shows(page, "picture", lambda seen: seen != whole)


def test_a_tab_per_sensor_and_honest_empty_states(
    staged: Callable[..., Stage], open_page: Callable[..., Any]
) -> None:
    stage = staged(hello("left", "right"))
    page = open_page(stage.url)
    status(page, "waiting")
    assert page.inner_text("#empty-title") == "Waiting for frames"
    assert page.inner_text("#tabs").split() == ["left", "right"]
    for sensor in ("left", "right"):
        stage.send(state(sensor))
    stage.send(frame("left", 1, 200))
    watch(page)
    stage.send(frame("right", 2, 90, contact=True))
    until(page, "() => document.getElementById('count-lost').textContent === '1'")
    left = steady(page, "picture")
    assert page.inner_text("#unit-area") == "no contact"
    page.click("#tabs button:nth-child(2)")
    assert page.get_attribute("#tabs button:nth-child(2)", "aria-selected") == "true"
    assert shows(page, "picture", lambda seen: seen != left)
    until(page, "() => document.getElementById('unit-angle').textContent === 'no direction'")
    assert page.inner_text("#unit-flow") == "no marker inside"
    assert page.inner_text("#source") == "camera of right"
    assert page.inner_text("#source-state").endswith("connected")
    page.keyboard.press("ArrowLeft")
    assert page.get_attribute("#tabs button:nth-child(1)", "aria-selected") == "true"
    assert shows(page, "picture", lambda seen: seen == left)
    status(page, "stalled")
    assert re.match(r"no frames for \d+ s", page.inner_text("#status-text"))
    stage.send(frame("left", 3, 100))
    status(page, "live")
    until_heard(page, stage, {"ack": 3})
    assert stage.heard == [{"ack": 1}, {"ack": 2}, {"ack": 3}]
    stage.send(state("left", end="eos"))
    status(page, "ended")
    assert "The source has ended." in page.inner_text("#empty-text")


def test_a_calibrated_sensor_is_shown_in_millimetres_with_force_slip_and_field(
    staged: Callable[..., Stage], open_page: Callable[..., Any]
) -> None:
    stage = staged(hello("main"), state("main"), frame("main", 1, 120, contact=True, directed=True))
    page = open_page(stage.url)
    watch(page)
    absent = ("unit", *(f"layer-{name}" for name in ("field", "surface")))
    for name in (*absent, *(f"tile-{name}" for name in ("depth", "force", "slip", "pose"))):
        assert page.is_hidden(f"#{name}"), name
    page.keyboard.press("u")
    assert page.inner_text("#value-area") == "300"
    stage.send(calibrated(2))
    until(page, "() => document.getElementById('unit-area').textContent === 'mm² at 0.1, −0.2 mm'")
    assert page.inner_text("#unit-slip") == "80\u202f% of the contact sticks, slid 0.50 mm, turned 5.0°"
    texts = {name: page.inner_text(f"#value-{name}") for name in ("area", "flow", "depth", "force", "slip")}
    assert texts == {"area": "3.00", "flow": "0.447", "depth": "0.500", "force": "2.50", "slip": "holds"}
    assert page.inner_text("#value-pose") == "0.50"
    assert page.inner_text("#unit-pose") == "mm ± 0.02, turned 5.0 ± 57.0°"
    assert page.inner_text("#unit-flow").startswith("mm ± 0.032, 3 markers")
    assert page.inner_text("#unit-force") == "N ± 0.20"
    stage.send(calibrated(3, as_calibrated=False))
    until(page, "() => document.getElementById('unit-force').textContent === 'N ± 0.20, the gel has changed'")
    stage.send(calibrated(3, height=0.4, in_range=False))
    until(page, "() => document.getElementById('unit-force').textContent === 'N, outside the fit'")
    in_mm = {name: steady(page, name) for name in ("picture", "plot-area", "plot-flow")}
    page.keyboard.press("u")
    assert page.inner_text("#unit-area") == "px²"
    assert page.inner_text("#unit-flow").startswith("px ± 0.32, 3 markers")
    for name, seen in in_mm.items():
        assert shows(page, name, lambda now, seen=seen: now != seen), name
    page.reload()
    watch(page)
    stage.send(calibrated(4, slipping=True))
    until(page, "() => document.getElementById('value-slip').textContent === 'slips'")
    assert page.inner_text("#unit-area") == "px²", "the unit is remembered"
    without = steady(page, "picture")
    page.keyboard.press("7")
    assert shows(page, "picture", lambda seen: seen != without)


def until_heard(page: Any, stage: Stage, message: Any, times: int = 1) -> None:
    """Wait until the page has said something so many times."""
    deadline = time.monotonic() + PATIENCE / 1000
    while stage.heard.count(message) < times:
        assert time.monotonic() < deadline, stage.heard
        page.wait_for_timeout(20)


def middle(png: bytes) -> NDArray[np.uint8]:
    """A picture without its rim, on which the ring around what has the focus may lie."""
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return np.asarray(picture[10:-10, 10:-10], np.uint8)


@pytest.mark.parametrize("webgl", [True, False], ids=["webgl", "no webgl"])
def test_the_surface_is_shaded_and_can_be_turned_where_there_is_webgl(
    webgl: bool,
    staged: Callable[..., Stage],
    open_page: Callable[..., Any],
    request: pytest.FixtureRequest,
) -> None:
    stage = staged(hello("main"), state("main"), calibrated(1))
    name = "browser" if webgl else "browser_without_webgl"
    page = open_page(stage.url, browser=request.getfixturevalue(name))
    watch(page)
    until(page, "() => !document.getElementById('layer-surface').hidden")
    assert page.is_hidden("#surface")
    page.click("#layer-surface")
    until(page, "() => document.getElementById('deepest').textContent === '0.6 mm'")
    page.locator("#surface").scroll_into_view_if_needed()
    picture = middle(steady(page, "surface"))
    # Of each hue of the ramp something is seen: dark purple at rest, green at the top.
    blue, green, red = (picture[..., channel].astype(int) for channel in range(3))
    assert ((blue > green + 40) & (red > green + 30)).sum() > 1000
    assert ((green > red + 40) & (green > blue + 20)).sum() > 50
    page.focus("#surface")
    page.keyboard.press("ArrowLeft")
    if not webgl:
        assert "no WebGL" in page.inner_text("#turn-hint")
        assert np.array_equal(middle(steady(page, "surface")), picture)
        return
    assert shows(page, "surface", lambda seen: not np.array_equal(middle(seen), picture))
    page.keyboard.press("Home")
    assert shows(page, "surface", lambda seen: np.array_equal(middle(seen), picture))
    box = page.locator("#surface").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 160, box["y"] + 80)
    page.mouse.up()
    assert shows(page, "surface", lambda seen: not np.array_equal(middle(seen), picture))
    page.dblclick("#surface")
    assert shows(page, "surface", lambda seen: np.array_equal(middle(seen), picture))
    page.keyboard.press("z")
    assert page.inner_text("#rise span") == "Heights × 5"
    assert shows(page, "surface", lambda seen: not np.array_equal(middle(seen), picture))


def test_buttons_and_keys_send_commands_or_say_why_not(
    staged: Callable[..., Stage], open_page: Callable[..., Any]
) -> None:
    stage = staged(hello("main"), state("main", recording=True), frame("main", 1, 120))
    page = open_page(stage.url)
    watch(page)
    assert page.inner_text("#record .label") == "Stop recording"
    assert page.get_attribute("#record", "aria-pressed") == "true"
    commands = {"pause": (" ", True), "reference": ("n", None), "record": ("r", False), "stop": ("q", None)}
    for name, (key, value) in commands.items():
        page.click(f"#{name}")
        page.evaluate("document.activeElement.blur()")
        page.keyboard.press(key)
        until_heard(page, stage, {"do": name, "value": value}, times=2)
    stage.send(json.dumps({"type": "note", "text": "it failed"}))
    until(page, "() => document.getElementById('note').textContent === 'it failed'")
    why = "a live source cannot be stepped"
    stage.send(state("main", refused={name: why if name == "step" else None for name in (*commands, "step")}))
    until(page, "why => document.getElementById('step').title === why", why)
    assert page.is_disabled("#step")
    page.keyboard.press("s")
    # A note is hidden after some seconds.
    assert why in page.text_content("#note")


def test_a_session_of_presses_is_guided(staged: Callable[..., Stage], open_page: Callable[..., Any]) -> None:
    def guided(number: int, **changes: Any) -> bytes:
        good = {"center": [10.0, 10.0], "radius": 5.0, "fault": None}
        light = {"center": [40.0, 20.0], "radius": 2.0, "fault": "light; press harder"}
        guide = {"now": "Press the ball firmly at the upper left.", "done": 2, "good": 1, "wanted": 4}
        guide |= {"next": [0, 0], "lasts": False, "presses": [good, light]} | changes
        return with_header(frame("main", number, 120), guide=guide)

    stage = staged(hello("main"), state("main"), frame("main", 1, 120))
    page = open_page(stage.url)
    watch(page)
    assert page.is_hidden("#tile-guide")
    plain = steady(page, "picture")
    stage.send(guided(2))
    until(page, "() => !document.getElementById('tile-guide').hidden")
    assert page.inner_text("#guide-now") == "Press the ball firmly at the upper left."
    assert page.get_attribute("#guide-now", "role") == "status"
    assert page.inner_text("#guide-count") == "2 of 4 presses, 1 good"
    assert page.inner_text("#guide-last") == "Press 2: light; press harder."
    assert page.evaluate("document.getElementById('guide-progress').value") == 0.5
    until(page, "() => document.querySelector('#stop .label').textContent === 'Finish'")
    assert shows(page, "picture", lambda seen: seen != plain)
    stage.send(guided(3, lasts=True, now="Lift the ball.", presses=[]))
    until(page, "() => document.getElementById('guide-now').textContent === 'Lift the ball.'")
    weights = {"now": "Take it off.", "note": "Load 2 is measured.", "noun": "loads", "good": 2, "next": None}
    stage.send(guided(4, presses=[], **weights))
    until(page, "() => document.getElementById('guide-now').textContent === 'Take it off.'")
    assert page.inner_text("#guide-count") == "2 of 4 loads"
    assert page.inner_text("#guide-last") == "Load 2 is measured."
    stage.send(state("main", end="signal"))
    until(page, "() => document.getElementById('empty-title').textContent === 'All presses are recorded'")


# -- one run that several tests watch: the last ones, so that it does not run beside the others -------------


def test_frames_and_plots_move(watched: Run, open_page: Callable[..., Any]) -> None:
    page = open_page(watched.url)
    watch(page)
    until(page, "() => Number(document.getElementById('plot-latency').dataset.points) > 20")
    until(page, "() => document.getElementById('value-area').textContent !== '–'")
    before = {name: pixels(page, name) for name in ("picture", "plot-area", "plot-latency")}
    advance(page, 30)
    for name, picture in before.items():
        assert shows(page, name, lambda seen, picture=picture: seen != picture), name
    until(page, "() => document.querySelectorAll('#stage-rows tr').length > 5")
    rows = page.inner_text("#stage-rows")
    assert "preprocess" in rows
    assert "no contact" in rows
    assert re.fullmatch(r"\d+ of 100000", page.inner_text("#frame-number"))
    until(page, "() => /^[0-9.]+.s$/.test(document.getElementById('rate').textContent)")
    assert "dropped" in page.inner_text("#links")
    assert page.inner_text("#source") == f"{ENDLESS}, 100000 frames at 60 fps"


def test_everything_can_be_reached_by_keyboard_and_has_a_name(
    watched: Run, open_page: Callable[..., Any]
) -> None:
    page = open_page(watched.url)
    watch(page)
    reached: list[str] = []
    for _ in range(20):
        page.keyboard.press("Tab")
        focus = page.evaluate(
            """() => {
                const e = document.activeElement, style = getComputedStyle(e);
                const name = e.getAttribute('aria-label') ?? e.textContent.trim();
                return [e.id, name, style.outlineStyle, parseFloat(style.outlineWidth)];
            }"""
        )
        if focus[0] == "":
            continue
        reached.append(focus[0])
        assert focus[1], focus
        assert focus[2] == "solid", focus
        assert focus[3] >= 2, focus
    assert {"pause", "reference", "stop", "layer-image", "layer-mean", "magnify"} <= set(reached)
    unnamed = page.evaluate(
        """() => [...document.querySelectorAll('canvas, progress, [role=tablist], [role=toolbar]')]
            .filter(e => !e.getAttribute('aria-label')).map(e => e.id)"""
    )
    assert unnamed == []


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("view-dark", {}),
        ("view-light", {"color_scheme": "light"}),
        ("view-narrow", {"viewport": {"width": 320, "height": 600}}),
        (
            "view-phone",
            {
                "viewport": {"width": 390, "height": 844},
                "device_scale_factor": 2,
                "is_mobile": True,
                "has_touch": True,
            },
        ),
    ],
)
def test_the_page_fits_its_window(
    name: str,
    options: dict[str, Any],
    watched: Run,
    open_page: Callable[..., Any],
    screenshots: Path,
) -> None:
    page = open_page(watched.url, **options)
    watch(page)
    pause_in_contact(page)
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    for button in ("pause", "stop", "layer-arrows"):
        box = page.locator(f"#{button}").bounding_box()
        assert box["x"] >= 0, button
        assert box["x"] + box["width"] <= options.get("viewport", {"width": 1400})["width"], button
    # A finger needs room.
    if options.get("is_mobile"):
        assert page.locator("#stop").bounding_box()["height"] >= 44
    background = page.evaluate("getComputedStyle(document.documentElement).backgroundColor")
    brightness = np.mean([float(part) for part in re.findall(r"[\d.]+", background)[:3]])
    assert (brightness > 128) == (options.get("color_scheme") == "light")
    page.click("#pause")
    status(page, "live")
    advance(page, 20)
    if "TACTFLOW_SCREENSHOTS" in os.environ:
        page.wait_for_timeout(10_000)
        until(page, DRAWN)
    page.screenshot(path=screenshots / f"{name}.png")
