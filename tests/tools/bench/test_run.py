"""`tactflow bench`: the quick run, and what the command says before and after one."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pytest

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.tools.bench.command import packaged_files
from tactflow.tools.bench.quantities import QUANTITIES
from tactflow.tools.bench.results import BenchResult
from tactflow.tools.bench.run import measure_scene
from tactflow.tools.bench.scenes import Case
from tests.terminal import Terminal

# The run takes a minute on a quiet machine, twenty on one with a lot of other work.
pytestmark = pytest.mark.timeout(3600)

BASELINE = Path(__file__).with_name("baseline_quick.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the results of the quick run, b.json, made once as it takes long.

    Nothing may be worse than in the stored run. After a change that is meant to move errors, store them anew:
    `tactflow bench --quick --json tests/tools/bench/baseline_quick.json`.
    """
    folder = tmp_path_factory.mktemp("bench")
    outputs = ["--json", str(folder / "b.json"), "--page", str(folder / "b.html")]
    words = ["bench", "--quick", *outputs, "--against", str(BASELINE)]
    assert main(words) == 0
    return folder


def test_every_pipeline_and_every_method_is_timed_and_judged(folder: Path) -> None:
    stored = json.loads((folder / "b.json").read_text())
    assert stored["schema"] == "tactflow.bench/3"
    assert stored["failures"] == {}
    measured = stored["values"]
    for key in ("pipeline/default", "pipeline/classic", "inpaint/telea", "hull/default", "tracker/classic"):
        assert measured[f"{key}/bright_cable"]["contact_ms"] > 0
    expected = {"displacement_rms", "wrong_percent", "false_contacts", "missed_contacts"}
    assert expected <= measured["pipeline/default/bright_cable"].keys()
    # Given the true mask, the geometry is exact.
    assert measured["hull/default/bright_cable"]["center_error"] == pytest.approx(0, abs=1e-9)


def test_the_page_shows_costs_growth_latency_and_pictures(folder: Path) -> None:
    stored, page = json.loads((folder / "b.json").read_text()), (folder / "b.html").read_text()
    assert stored["costs"]["default"]["contact"]["difference"] > 0
    assert [grown["title"] for grown in stored["growth"]] == ["Picture", "Dots"]
    assert stored["latency_ms"].keys() >= {"p50", "p99"}
    for words in ("What a frame costs", "How the cost grows", "Latency", "What was found", "bright_cable"):
        assert words in page


def test_a_gel_without_markers_is_measured_without_a_tracker(tmp_path: Path) -> None:
    result, loaded = BenchResult(quick=True), {name: load_pipeline(p) for name, p in packaged_files().items()}
    measure_scene(result, tmp_path, loaded, Case("unmarked", 6))
    errors = {m.method: m.errors for m in result.measured}
    assert list(errors) == ["markerless", "classic"]
    assert not any("displacement_rms" in values for values in errors.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--against", "nothing.json"], "cannot be read"),
        (["--against", "other.json"], "not a result of `tactflow bench`"),
        (["--against", __file__], "not JSON"),
        (["--json", f"{__file__}/x.json"], "test_run.py is not a folder"),
        (["nothing.yaml"], "no such pipeline"),
        (["--scene", "nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_refused_before_anything_is_measured(
    arguments: list[str], message: str, terminal: Terminal
) -> None:
    Path("other.json").write_text('{"schema": "other/1"}')
    assert terminal("bench", "--quick", *arguments) == 2
    assert message in terminal.err


def measured(scene: str = "press", **errors: float) -> BenchResult:
    """A run that measured these errors of one pipeline."""
    result = BenchResult(quick=True)
    times = {"contact": [0.003, 0.001, 0.002], "idle": [0.0001]}
    result.add("pipeline", "default", scene, errors, times=times, frames=4)
    return result


ALLOWED = QUANTITIES["displacement_rms"].allowed(0.02)


@pytest.mark.parametrize(
    ("before", "now", "worse"),
    [
        (measured(displacement_rms=0.02), measured(displacement_rms=ALLOWED), ""),
        (
            measured(displacement_rms=0.02),
            measured(displacement_rms=ALLOWED + 1e-6),
            "default/press: marker displacement error, RMS: was 0.02, allowed 0.026",
        ),
        (measured(marker_recall=0.9), measured(marker_recall=1.0), ""),
        (measured(marker_recall=0.9), measured(marker_recall=0.8), "was 0.9, allowed"),
        (measured(displacement_rms=0.02), measured(wrong_percent=0.0), "no longer measured"),
        (measured("cable", displacement_rms=0.02), measured(displacement_rms=0.02), "no longer measured"),
    ],
)
def test_the_command_fails_when_an_error_grew(
    before: BenchResult, now: BenchResult, worse: str, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    before.save(Path("before.json"))
    monkeypatch.setattr("tactflow.tools.bench.command.run_bench", lambda *_, **__: now)
    words = ["bench", "--quick", "--json", "now.json", "--against", "before.json"]
    assert terminal(*words) == (3 if worse else 0)
    assert (worse or "no error has increased") in terminal.err
    # Scenes that were not chosen are not compared.
    chosen = "press" in str(before.measured)
    assert terminal(*words, "--scene", "press") == (3 if worse and chosen else 0)


def test_every_kind_of_measurement_has_its_row(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    result = measured(displacement_rms=0.01, hull_iou=0.97, false_contacts=0, missed_contacts=4)
    for method, scene, ms, rms, wrong in (
        ("slow & <exact>", "press", 5.0, 0.01, 0),
        ("fast", "press", 0.5, 0.1, 1),
        ("fast", "cable", 0.6, 0.3, 3),
    ):
        errors = {"displacement_rms": rms, "wrong_percent": wrong}
        result.add("tracker", method, scene, errors, times={"contact": [ms / 1e3]}, frames=1)
    result.failures["pipeline/classic/press"] = "no markers\nmore"
    monkeypatch.setattr("tactflow.tools.bench.command.run_bench", lambda *_, **__: result)
    assert terminal("bench", "--quick") == 0
    lines = terminal.out.splitlines()
    rows = [" ".join(line.split()) for line in lines if line.startswith("|")]
    assert "| fast | 0.55 | - | 0.2 (0.3) | - | 2 (3) |" in rows
    assert "| press | default | 2 | -, - | 0.01 | -, - | 0, 4, - | 0.97 | - | - | - |" in rows
    assert "| pipeline/classic/press | no markers |" in rows
    for above, below in pairwise(lines):
        if above.startswith("|") and below.startswith("|"):
            assert len(above) == len(below)
