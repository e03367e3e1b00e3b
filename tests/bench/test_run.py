from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactflow.bench.pipelines import Bench
from tactflow.bench.results import BenchResult, load_errors, regressions
from tactflow.bench.run import Plan, measure_scene, run_bench
from tactflow.bench.scenes import Case
from tactflow.bench.timing import CopyUnit
from tactflow.cli.bench import packaged_files
from tactflow.cli.main import main
from tactflow.config.load import load_pipeline

# The run takes a minute on a quiet machine, twenty on one with a lot of other work.
pytestmark = pytest.mark.timeout(3600)

BASELINE = Path(__file__).with_name("baseline_quick.json")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run puts its pictures."""
    return tmp_path_factory.mktemp("bench") / "pictures"


@pytest.fixture(scope="module")
def result(pictures: Path) -> BenchResult:
    """The quick run, made once as it takes long."""
    steps: list[tuple[int, int]] = []
    plan = Plan(packaged_files(), quick=True, pictures=pictures)
    made = run_bench(plan, lambda _what, done, total: steps.append((done, total)))
    assert steps == sorted(steps)
    assert steps[-1][0] == steps[-1][1]
    return made


def test_no_error_of_the_quick_bench_got_worse_than_the_stored_one(result: BenchResult) -> None:
    """After a change that is meant to move errors, store them anew: `bench --quick --json FILE`."""
    assert result.failures == {}
    assert regressions(result, load_errors(BASELINE, quick=True)) == []


def test_every_pipeline_and_every_method_is_timed_and_judged(result: BenchResult) -> None:
    found = {m.key: m for m in result.measured if m.scene == "bright_cable"}
    for key in ("pipeline/default", "pipeline/classic", "inpaint/telea", "hull/default", "tracker/classic"):
        assert found[f"{key}/bright_cable"].values["contact_ms"] > 0
    errors = found["pipeline/default/bright_cable"].errors
    assert {"displacement_rms", "wrong_percent", "false_contacts", "missed_contacts"} <= errors.keys()
    # Given the true mask, the geometry is exact.
    assert found["hull/default/bright_cable"].errors["center_error"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("case", "methods"),
    [
        (Case("unmarked", 6), ["markerless", "classic"]),
        # So faint that the pipeline for markers refuses to run.
        (Case("speckle", 2, "speckle=0.01"), ["default", "markerless", "classic"]),
    ],
)
def test_a_gel_without_markers_is_measured_without_a_tracker(
    case: Case, methods: list[str], tmp_path: Path
) -> None:
    bench = Bench(BenchResult(quick=True), CopyUnit(), tmp_path)
    measure_scene(bench, {name: load_pipeline(path) for name, path in packaged_files().items()}, case)
    found = {m.method: m.errors for m in bench.result.measured}
    assert list(found) == methods
    assert found.pop("default", {"markers_false": 0}) == {"markers_false": 0}
    assert not any("displacement_rms" in errors for errors in found.values())


@pytest.mark.usefixtures("result")
def test_pictures_show_the_worst_frame_of_every_pipeline(pictures: Path) -> None:
    names = sorted(path.name for path in pictures.iterdir())
    scenes = ("bright_cable", "jumps", "press")
    assert names == [f"{scene}-{name}.png" for scene in scenes for name in ("classic", "default")]
    picture = cv2.imread(str(pictures / names[0]))
    assert picture is not None
    assert picture.shape == (2 * 400, 2 * 300, 3)
    # The truth's outline is drawn in red.
    assert np.any(np.all(picture == (0, 0, 255), axis=2))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--against", "nothing.json"], "cannot be read"),
        (["--html", f"{__file__}/x.html"], "test_run.py is not a folder"),
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


def test_the_command_writes_results_and_fails_when_something_got_worse(
    result: BenchResult,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tactflow.cli.bench.run_bench", lambda _plan, _progress: result)
    assert main(["bench", "--quick", "--json", "b.json", "--html", "b.html"]) == 0
    out, err = capsys.readouterr()
    assert "### Whole pipelines" in out
    assert "b.html" in err
    stored = json.loads((tmp_path / "b.json").read_text())
    assert stored["schema"] == "tactflow.bench/3"
    assert len(stored["values"]) == len(result.measured)
    assert "Whole pipelines" in (tmp_path / "b.html").read_text()
    assert main(["bench", "--quick", "--json", "c.json", "--against", "b.json"]) == 0
    assert "nothing got worse" in capsys.readouterr().err
    stored["values"]["pipeline/default/bright_cable"]["displacement_rms"] /= 10
    (tmp_path / "b.json").write_text(json.dumps(stored))
    assert main(["bench", "--quick", "--json", "c.json", "--against", "b.json"]) == 3
    assert "pipeline/default/bright_cable: marker displacement error" in capsys.readouterr().err
