"""Labelling: the file of labels, the server, and the page in a browser."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lab.judges.label import LabelServer, main, read_items
from lab.judges.label_file import FrameLabel, load_labels, save_labels
from tactflow.engine.errors import ConfigError
from tests.clock import PATIENCE

TRIANGLE = ((10.0, 10.0), (50.5, 10.0), (30.0, 40.0))


def entry(**changes: Any) -> dict[str, Any]:
    """One entry of the file, as JSON has it."""
    plain = {"recording": "left", "frame": 3, "reference": 0, "contact": True, "outlines": [TRIANGLE]}
    return plain | changes


def test_a_file_of_labels_is_read_as_it_was_written(tmp_path: Path) -> None:
    labels = [
        FrameLabel(recording="left", frame=3, reference=0, lab="A", contact=True, outlines=(TRIANGLE,)),
        FrameLabel(recording="left", frame=3, reference=0, lab="A", round=2, contact=None),
        FrameLabel(recording="finger/ü", frame="003", reference="000", contact=False, dots=((1.5, 2.0),)),
    ]
    save_labels(tmp_path / "labels.json", labels)
    assert load_labels(tmp_path / "labels.json") == labels
    first, second, third = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert first["outlines"] == [[list(point) for point in TRIANGLE]]
    assert second["contact"] is None
    assert "dots" not in first
    assert third["dots"] == [[1.5, 2.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a file of labels: Invalid JSON"),
        ([entry(), {"recording": "left"}], "entry 2, frame: Field required"),
        ([entry(outlins=[])], "entry 1, outlins: "),
        ([entry(outlines=[TRIANGLE[:2]])], "entry 1: an outline requires 3 points or more"),
        ([entry(outlines=[[*TRIANGLE, [0, float("nan")]]])], r"entry 1, outlines.0.3.1: .* finite"),
        ([entry(), entry(round=2), entry()], "entry 3: the same frame and round as entry 1"),
    ],
)
def test_a_broken_file_of_labels_is_refused(text: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "labels.json"
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    with pytest.raises(ConfigError, match=f"^{path}: {message}"):
        load_labels(path)


@pytest.fixture
def press(tmp_path: Path) -> Path:
    """A folder of four pictures, 80 x 60, each of one grey level."""
    folder = tmp_path / "finger" / "press"
    folder.mkdir(parents=True)
    for name, level in [("000", 40), ("001", 80), ("002", 120), ("rest", 160)]:
        cv2.imwrite(str(folder / f"{name}.png"), np.full((60, 80, 3), level, np.uint8))
    return folder


Serve = Callable[..., LabelServer]


@pytest.fixture
def serve(press: Path, tmp_path: Path) -> Iterator[Serve]:
    """Starts servers for two frames of the folder."""
    started = []

    def start(**options: Any) -> LabelServer:
        items = read_items(str(press), "press", "rest", ["001", "2"])
        server = LabelServer(items, tmp_path / "labels.json", **options)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        started.append((server, thread))
        return server

    yield start
    for server, thread in started:
        server.shutdown()
        thread.join()
        server.server_close()


def ask(server: LabelServer, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
    """Status and body of the answer to a request, by default one of the page itself."""
    own = {"Origin": server.address.rstrip("/")}
    connection = HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)
    connection.request(method, path, json.dumps(body), own | headers)
    response = connection.getresponse()
    answer = response.status, response.read()
    connection.close()
    return answer


def level(png: bytes) -> int:
    """The grey level of one of the pictures."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return int(image[0, 0, 0])


def test_frames_are_chosen_by_name_index_and_step(press: Path) -> None:
    chosen = read_items(str(press), "a", "rest", ["001", "2"])
    assert [(item.frame, item.reference, level(item.picture)) for item in chosen] == [
        ("001", "rest", 80),
        ("002", "rest", 120),
    ]
    assert level(chosen[0].reference_picture) == 160
    assert [item.frame for item in read_items(str(press), "a", every=3)] == ["rest"]
    np.save(press / "frames.npy", np.zeros((5, 48, 64), np.uint8))
    found = read_items(str(press / "frames.npy"), "a", every=2)
    assert [(item.frame, item.reference) for item in found] == [(2, 0), (4, 0)]
    with pytest.raises(ConfigError, match="has no frame 7; it has 4 frames"):
        read_items(str(press), "a", frames=["7"])
    with pytest.raises(ConfigError, match="no frame 'rset'"):
        read_items(str(press), "a", "rset")


def test_other_web_sites_and_wrong_labels_are_refused(serve: Serve, tmp_path: Path) -> None:
    server, label = serve(), entry(recording="press", frame="001", reference="rest")
    assert ask(server, "GET", "/frames", Host="evil.example")[0] == 421
    assert ask(server, "POST", "/labels", label, Origin="http://evil.example")[0] == 403
    assert ask(server, "DELETE", "/labels", label, Origin="null")[0] == 403
    assert ask(server, "POST", "/labels", label | {"contact": False})[0] == 400
    assert not (tmp_path / "labels.json").exists()


def test_a_broken_file_of_labels_is_never_overwritten(
    serve: Serve, press: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server, path = serve(), tmp_path / "labels.json"
    path.write_text("[{")
    status, message = ask(server, "POST", "/labels", entry(recording="press", frame="001"))
    assert (status, path.read_text()) == (500, "[{")
    assert b"not a file of labels" in message
    assert main([str(press), "--labels", str(path), "--every", "1"]) == 2
    assert "not a file of labels" in capsys.readouterr().err


def shown(page: Any, text: str) -> None:
    """Wait for a text on the page, and until everything is saved."""
    page.wait_for_function("text => document.body.innerText.includes(text)", arg=text)
    page.evaluate("saving")


def at(page: Any, x: float, y: float) -> tuple[float, float]:
    """Where a place in raw pixels is on the screen."""
    box = page.locator("#frame-picture").bounding_box()
    return box["x"] + (x + 0.5) * box["width"] / 80, box["y"] + (y + 0.5) * box["height"] / 60


def test_an_outline_drawn_in_a_browser_is_in_the_file(
    serve: Serve, open_page: Callable[..., Any], tmp_path: Path
) -> None:
    page, path = open_page(serve(lab="A").address), tmp_path / "labels.json"
    shown(page, "1 of 2")
    for x, y in [(10, 10), (50, 10), (50, 40)]:
        page.mouse.click(*at(page, x, y))
    page.mouse.dblclick(*at(page, 20, 50))
    shown(page, "outlines: 1")
    (label,) = load_labels(path)
    assert (label.recording, label.frame, label.reference, label.lab) == ("press", "001", "rest", "A")
    np.testing.assert_allclose(label.outlines, [[(10, 10), (50, 10), (50, 40), (20, 50)]], atol=0.1)

    page.mouse.move(*at(page, 50, 10))
    page.mouse.down()
    page.mouse.move(*at(page, 60, 20))
    page.mouse.up()
    page.evaluate("saving")
    np.testing.assert_allclose(load_labels(path)[0].outlines[0][1], (60, 20), atol=0.1)
    page.keyboard.press("Control+z")
    page.evaluate("saving")
    assert load_labels(path) == [label]

    page.keyboard.press("ArrowRight")
    shown(page, "2 of 2, 1 labelled")
    page.click("text=Nothing touches")
    shown(page, "2 of 2, 2 labelled")
    page.keyboard.press("ArrowLeft")
    shown(page, "1 of 2, 2 labelled")
    assert [stored.contact for stored in load_labels(path)] == [True, False]
    # A label that is there is shown, and can be deleted.
    page.reload()
    shown(page, "outlines: 1")
    page.mouse.click(*at(page, 40, 25), button="right")
    shown(page, "outlines: 0")
    assert [stored.frame for stored in load_labels(path)] == ["002"]
