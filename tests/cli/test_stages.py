"""`stages` shows what can be used and how."""

from __future__ import annotations

import shutil
from pathlib import Path

from tactflow.config.registry import catalogue
from tests.terminal import Terminal

PARTS = Path(__file__).resolve().parents[1] / "config" / "parts.py"


def test_the_table_has_a_line_for_every_stage_and_sink(terminal: Terminal) -> None:
    assert terminal("stages") == 0
    out, err = terminal.out, terminal.err
    assert err == ""
    heading, *rows = out.splitlines()
    assert heading.split() == ["NAME", "KIND", "INPUTS", "OUTPUTS", "ORIGIN", "WHAT", "IT", "DOES"]
    assert sorted(row.split()[:2] for row in rows) == sorted([c.name, c.kind] for c in catalogue()[0])
    hull = next(row for row in rows if row.startswith("hull "))
    ports = ["contact_mask,", "evidence?,", "deviations?,", "core_mask?", "contact"]
    assert hull.split()[:8] == ["hull", "stage", *ports, "built-in"]


def test_alternatives_stand_below_the_stage_that_they_can_replace(terminal: Terminal) -> None:
    assert terminal("stages") == 0
    names = [row[:20].rstrip() for row in terminal.out.splitlines()]
    below = names[names.index("hull") + 1 : names.index("inpaint")]
    assert below == ["  classic_hull", "  fit_line", "  min_area_rect"]
    assert terminal("stages", "tracker") == 0
    assert "can be replaced by: classic_tracker, dis_flow, lucas_kanade, nearest_dots, rlof" in terminal.out


def test_one_stage_is_explained_with_ports_and_parameters(tmp_path: Path, terminal: Terminal) -> None:
    shutil.copy(PARTS, tmp_path / "parts.py")
    assert terminal("stages", "./parts.py:Prepare") == 0
    lines = [line.strip() for line in terminal.out.splitlines()]
    assert lines[0] == "./parts.py:Prepare: stage, ./parts.py"
    assert "memory: pure" in lines
    assert "frame  Frame" in lines
    assert "image  (H, W, 3) uint8, grey levels, BGR" in lines
    assert lines[lines.index("rotate: 0 | 90 | 180 | 270 = 0") + 1] == "degrees"
    assert "gamma: number, > 0, <= 5 = 1.0" in lines
    assert "corners: list of [number, number] = []" in lines
    assert "size: [whole number, whole number] or null = null" in lines
    assert "lens.focal: number, > 0 (required)" in lines
    assert "lens.fisheye: true | false = false" in lines


def test_every_parameter_of_a_built_in_is_described() -> None:
    for component in catalogue()[0]:
        assert component.cls.__doc__
        for name, field in component.params.model_fields.items():
            assert field.description, f"{component.name}.{name}"
