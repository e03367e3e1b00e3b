from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from tactflow.bench.markdown import BEGIN, END, markdown, write_markdown
from tactflow.bench.pipelines import ORIGINAL
from tactflow.bench.results import Measurement, Result, Target


@pytest.fixture
def result() -> Result:
    made = Result(quick=True, copy_ms=0.1, touch_ms=0.05, fault_us=0.4)
    for method, milliseconds, rms in (("default", 1.5, 0.01), ("classic", 50.0, 0.3), (ORIGINAL, 100.0, 0.3)):
        measurement = Measurement("pipeline", method, "press", errors={"displacement_rms": rms})
        measurement.time["contact"] = {"cpu_ms_p50": milliseconds}
        made.measurements.append(measurement)
    made.measurements.append(
        Measurement("inpaint", "ns", "press", copies={"idle": 9}, errors={"inpaint_mae": 1.5})
    )
    made.measurements.append(
        Measurement("pipeline", "classic", "data:wedge_roll", failure="no markers\nmore")
    )
    trouble = {"hull_iou": 0.91, "false_contacts": 0.0}
    made.measurements.append(Measurement("pipeline", "markerless", "halo", errors=trouble))
    gel = {"dots_found": 97.6, "dots_beyond": 0.0}
    made.measurements.append(Measurement("pipeline", "default", "data:sts_640", frames=296, errors=gel))
    made.targets.append(Target("markers", "<= 0.03 px", "0.01", True, "press"))
    return made


def test_a_scene_has_one_row_with_script_yardstick_and_default(result: Result) -> None:
    (row,) = [line for line in markdown(result, "default").splitlines() if line.startswith("| press |")]
    assert row.startswith("| press | 100 | 50 | 1.5 | 0.3, 0.01 | -, - |")


def test_every_table_has_as_many_cells_in_each_row(result: Result) -> None:
    lines = markdown(result, "default").splitlines()
    for above, below in pairwise(lines):
        if above.startswith("|") and below.startswith("|"):
            assert above.count("|") == below.count("|")


def test_methods_promises_and_failures_are_listed(result: Result) -> None:
    text = markdown(result, "default")
    assert "| markers | ≤ 0.03 px | 0.01 | met | press |" in text
    assert "| `ns` | - | 9 | 1.5 (1.5) |" in text
    assert "| wedge_roll | `classic` | - | no markers |" in text


def test_troubles_and_real_gels_have_tables_of_their_own(result: Result) -> None:
    lines = markdown(result, "default").splitlines()
    (halo,) = [line for line in lines if line.startswith("| halo |")]
    assert "| `markerless` | - | - | - | 0 | - | - | 0.91 | - |" in halo
    (gel,) = [line for line in lines if line.startswith("| sts_640 |")]
    assert "| chosen on | 296 | 165 | 97.6 (0) | - | - |" in gel


def test_an_existing_page_keeps_its_own_text(result: Result, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\n{BEGIN}\nstale words\n{END}\n\nmore text\n", encoding="utf-8")
    for _ in range(2):
        write_markdown(result, page, "default")
    text = page.read_text(encoding="utf-8")
    assert text.startswith("# Title\n\n")
    assert text.endswith(f"{END}\n\nmore text\n")
    assert "stale words" not in text
    assert text.count("### Promises and results") == 1


def test_a_new_file_holds_the_tables(result: Result, tmp_path: Path) -> None:
    write_markdown(result, tmp_path / "new.md", "default")
    assert "| press |" in (tmp_path / "new.md").read_text(encoding="utf-8")
