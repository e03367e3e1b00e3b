from __future__ import annotations

import json
from pathlib import Path

from lab.peers import contact, dots, page
from lab.peers.__main__ import CONTACTS, SCENES, available, cases
from tactflow.sim import open_scene
from tactflow.tools.bench.scenes import Case

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_every_number_of_the_page_is_in_the_file_beside_it() -> None:
    numbers = json.loads((DOCS / "peers.json").read_text())
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == page.text(numbers, "peers.jpg")


def test_tactflow_is_measured_where_no_peer_is_installed(tmp_path: Path) -> None:
    case = Case("press", 24)
    found = dots.on_named([case], tmp_path, ["tactflow"])
    assert found["all"]["tactflow"]["displacement_rms"] < 0.05
    assert found["all"]["tactflow"]["lost_percent"] == 0
    assert found["ms"]["tactflow"] > 0
    found = contact.on_named([case], tmp_path, ["OpenCV difference"])
    assert found["all"]["tactflow"]["contact_iou"] > found["all"]["OpenCV difference"]["contact_iou"]
    assert found["all"]["tactflow"]["false_contacts"] == 0


def test_the_scenes_of_the_command_exist_and_tactflow_is_always_measured() -> None:
    for case in cases(f"{SCENES} {CONTACTS}", 4):
        assert len(open_scene(f"{case.name}?frames=4&{case.query}".rstrip("&"))) == 4
    assert "tactflow" in available(dots.METHODS)
    assert {"classic script", "OpenCV difference"} <= set(available(contact.PEERS))
