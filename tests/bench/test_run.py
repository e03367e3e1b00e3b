from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tactflow.bench.compare import against
from tactflow.bench.pipelines import ORIGINAL
from tactflow.bench.results import Measurement, Result
from tactflow.bench.run import Plan, run_bench
from tactflow.bench.scenes import FULL, QUICK, TROUBLES, Case
from tactflow.bench.targets import judge
from tactflow.cli.bench import packaged_files
from tactflow.cli.main import main
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError

FILES = {name: find_pipeline(name) for name in ("default", "classic")}


# The run takes a minute on a quiet machine, twenty on one with a lot of other work.
pytestmark = pytest.mark.timeout(3600)

BASELINE = Path(__file__).with_name("baseline_quick.json")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the run puts its pictures."""
    return tmp_path_factory.mktemp("bench") / "pictures"


@pytest.fixture(scope="module")
def result(pictures: Path) -> Result:
    """The quick run, made once as it takes long, with two gels more: a bare and a blotched one."""
    plan = Plan(
        packaged_files(),
        quick=True,
        memory=False,
        pictures=pictures,
        cases=(*QUICK, Case("unmarked", 6), Case("speckle", 2, "speckle=0.01")),
    )
    steps: list[tuple[int, int]] = []
    made = run_bench(plan, lambda _what, done, total: steps.append((done, total)))
    assert steps == sorted(steps)
    assert steps[-1][0] == steps[-1][1]
    return made


def test_no_error_of_the_quick_bench_got_worse_than_the_stored_one(result: Result) -> None:
    """After a change that is meant to move errors, store them anew: `bench --quick --write-baseline FILE`."""
    assert [m.failure for m in result.measurements if m.failure] == []
    assert [str(regression) for regression in against(result, BASELINE)] == []


def test_every_pipeline_is_measured_on_every_scene_with_markers(result: Result) -> None:
    found = {m.method: m for m in result.of("pipeline") if m.scene == "bright_cable"}
    assert found.keys() == {"default", "classic", ORIGINAL}
    assert not [m.failure for m in found.values() if m.failure]
    for m in found.values():
        assert {"displacement_rms", "wrong_percent", "false_contacts", "missed_contacts"} <= m.errors.keys()
        assert m.copies["contact"] > 0
    assert found["default"].limits["displacement_rms"] < found["default"].errors["displacement_rms"]


def test_the_script_costs_more_than_the_classic_pipeline_and_says_the_same(result: Result) -> None:
    found = {m.method: m for m in result.of("pipeline") if m.scene == "bright_cable"}
    assert found[ORIGINAL].errors == found["classic"].errors
    # It does everything twice that costs most; half of that would already be a quarter more.
    assert found[ORIGINAL].copies["contact"] > 1.25 * found["classic"].copies["contact"]


def test_a_gel_without_markers_is_measured_without_a_tracker(result: Result) -> None:
    found = [m for m in result.of("pipeline") if m.scene == "unmarked"]
    assert found
    for m in found:
        assert m.failure is None
        assert "displacement_rms" not in m.errors
        assert "tracker" not in m.stages_ms


def test_a_gel_with_blotches_is_offered_to_the_pipeline_for_markers_as_well(result: Result) -> None:
    (found,) = [
        m for m in result.of("pipeline", "default") if "markers_false" in m.errors and m.scene == "speckle"
    ]
    assert found.failure is None
    assert found.errors == {"markers_false": 0}  # so faint that it refuses to run


def test_promises_name_what_was_not_measured(result: Result) -> None:
    targets = {t.quantity: t for t in result.targets}
    assert targets["marker displacement: RMS; 99th percentile"].met is not None
    assert targets["wedge_ball"].met is None
    assert "--data" in targets["wedge_ball"].on


def test_a_promise_is_judged_by_the_worst_scene() -> None:
    made = Result(quick=True, copy_ms=0.1)
    for scene, rms in (("press", 0.01), ("cable", 0.031)):
        errors = {"displacement_rms": rms, "displacement_p99": 0.05}
        made.measurements.append(Measurement("pipeline", "default", scene, errors=errors))
    target = next(
        t
        for t in judge(made, "default", None, wedge="wedge", markerless="markerless")
        if t.quantity.startswith("marker displacement")
    )
    assert target.met is False
    assert "cable" in target.on
    made.measurements[1].errors["displacement_rms"] = 0.03
    target = next(
        t
        for t in judge(made, "default", None, wedge="wedge", markerless="markerless")
        if t.quantity.startswith("marker displacement")
    )
    assert target.met is True


def test_the_time_of_a_contact_is_judged_by_the_median_scene_and_by_the_dearest() -> None:
    made = Result(quick=True, copy_ms=0.1)
    for scene, copies in (("press", 5.0), ("cable", 11.5), ("two", 6.0)):
        made.measurements.append(Measurement("pipeline", "default", scene, copies={"contact": copies}))
        script = Measurement("pipeline", "original script", scene, copies={"contact": 900.0})
        made.measurements.append(script)
    (target,) = (
        t
        for t in judge(made, "default", None, wedge="wedge", markerless="markerless")
        if t.quantity == "frame with contact"
    )
    assert target.met is False
    assert "6.0 copies, 11.5 at most; 150 times" in target.result
    assert "cable" in target.on


def test_an_unknown_scene_is_refused_before_anything_is_measured() -> None:
    with pytest.raises(ConfigError, match="nowhere"):
        run_bench(Plan(FILES, scenes=frozenset({"nowhere"})))


def test_scenes_can_be_chosen() -> None:
    whole, alone = Plan(FILES, scenes=frozenset({"press"})).chosen()
    assert [c.label for c in whole] == ["press"]
    assert [c.label for c in alone] == ["press"]
    assert Plan(FILES).chosen()[0] == (*FULL, *TROUBLES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--against", "nothing.json"], "cannot be read"),
        (["--html", "no/such/folder/x.html"], "--html: there is no folder"),
        (["nothing.yaml"], "no such pipeline"),
        (["--scene", "nowhere"], "nowhere"),
        (["--data", "."], "wedge_ball"),
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
    result: Result, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tactflow.cli.bench.run_bench", lambda _plan, _progress: result)
    files = ["--json", "b.json", "--html", "b.html", "--write-baseline", "e.json"]
    assert main(["bench", "--quick", *files]) == 0
    out, err = capsys.readouterr()
    assert "Whole pipelines" in out
    assert "b.html" in err
    assert json.loads((tmp_path / "b.json").read_text())["schema"] == "tactflow.bench/1"
    assert "Which method should I use" in (tmp_path / "b.html").read_text()
    assert main(["bench", "--quick", "--against", "e.json"]) == 0
    assert "nothing got worse" in capsys.readouterr().err
    stored = json.loads((tmp_path / "e.json").read_text())
    stored["errors"]["pipeline/default/bright_cable"]["displacement_rms"] /= 10
    (tmp_path / "e.json").write_text(json.dumps(stored))
    assert main(["bench", "--quick", "--against", "e.json"]) == 3
    assert "pipeline/default/bright_cable: marker displacement error" in capsys.readouterr().err


@pytest.mark.usefixtures("result")
def test_pictures_show_the_worst_frame_of_every_pipeline(pictures: Path) -> None:
    names = sorted(path.name for path in pictures.iterdir())
    seen = {"bright_cable": "default", "jumps": "default", "press": "default", "unmarked": "markerless"}
    assert names == [f"{scene}-{name}.png" for scene in seen for name in ("classic", seen[scene])]
    picture = cv2.imread(str(pictures / names[0]))
    assert picture is not None
    assert picture.shape == (2 * 400 + 24, 2 * 300, 3)
    # The truth's outline is drawn in green.
    assert np.any(np.all(picture == (80, 220, 60), axis=2))


def test_every_method_gets_a_time_and_the_errors_of_its_stage(result: Result) -> None:
    found = [m for m in result.measurements if m.group != "pipeline"]
    by_key = {m.key: m for m in found}
    assert not [m.failure for m in found if m.failure]
    assert by_key["inpaint/telea/bright_cable"].faster["contact"] == 1
    assert by_key["inpaint/telea/bright_cable"].errors["inpaint_mae"] > 0
    assert by_key["hull/default/bright_cable"].errors["center_error"] == pytest.approx(0, abs=1e-9)
    assert {"tracker", "hull", "inpaint", "marker_mask", "difference"} <= {m.group for m in found}
    assert all(m.copies for m in found)
