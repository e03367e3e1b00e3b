"""`tactflow bench`: the quick run, and what the command says before and after one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tactflow.bench.pipelines import Bench
from tactflow.bench.results import BenchResult
from tactflow.bench.run import measure_scene
from tactflow.bench.scenes import Case
from tactflow.bench.timing import CopyUnit
from tactflow.cli.bench import packaged_files
from tactflow.cli.main import main
from tactflow.config.load import load_pipeline

# The run takes a minute on a quiet machine, twenty on one with a lot of other work.
pytestmark = pytest.mark.timeout(3600)

BASELINE = Path(__file__).with_name("baseline_quick.json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Holds the results of the quick run, b.json, made once as it takes long.

    Nothing may be worse than in the stored run. After a change that is meant to move errors, store them anew:
    `tactflow bench --quick --json tests/bench/baseline_quick.json`.
    """
    folder = tmp_path_factory.mktemp("bench")
    words = ["bench", "--quick", "--json", str(folder / "b.json"), "--against", str(BASELINE)]
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


@pytest.mark.parametrize("case", [Case("unmarked", 6), Case("speckle", 2)])
def test_a_gel_without_markers_is_measured_without_a_tracker(case: Case, tmp_path: Path) -> None:
    bench = Bench(BenchResult(quick=True), CopyUnit(), tmp_path)
    measure_scene(bench, {name: load_pipeline(path) for name, path in packaged_files().items()}, case)
    errors = {m.method: m.errors for m in bench.result.measured}
    assert list(errors) == ["markerless", "classic"]
    assert not any("displacement_rms" in values for values in errors.values())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--against", "nothing.json"], "cannot be read"),
        (["--json", f"{__file__}/x.json"], "test_run.py is not a folder"),
        (["nothing.yaml"], "no such pipeline"),
        (["--scene", "nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_refused_before_anything_is_measured(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["bench", "--quick", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_the_command_fails_when_an_error_grew(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def measured(*_: Any, **__: Any) -> BenchResult:
        result = BenchResult(quick=True, copy_ms=0.1)
        result.add("pipeline", "default", "press", {"displacement_rms": next(errors)}, frames=1)
        return result

    errors = iter((0.01, 0.01, 0.1))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tactflow.cli.bench.run_bench", measured)
    assert main(["bench", "--quick", "--json", "b.json"]) == 0
    assert "### Whole pipelines" in capsys.readouterr().out
    assert main(["bench", "--quick", "--json", "c.json", "--against", "b.json"]) == 0
    assert "no error has increased" in capsys.readouterr().err
    assert main(["bench", "--quick", "--json", "c.json", "--against", "b.json"]) == 3
    assert "pipeline/default/press: marker displacement error" in capsys.readouterr().err
