"""`tactflow stress`: what its parts measure, and when a promise counts as broken."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tactflow.cli.main import main
from tactflow.config.shipped import find_pipeline
from tactflow.tools.bench.scenes import Case
from tactflow.tools.stress.arithmetic import strict
from tactflow.tools.stress.clips import SEEN_RMS, cases_for, clip
from tactflow.tools.stress.compare import difference
from tactflow.tools.stress.conditioning import TURNS
from tactflow.tools.stress.endurance import frames, run_endurance
from tactflow.tools.stress.parts import PROMISES, Check, Curve, Part, Worst
from tactflow.tools.stress.perturbation import PERTURBATIONS, doubling, noise_bound
from tactflow.tools.stress.report import Report, lines, stress_page
from tactflow.tools.stress.same import run_same
from tactflow.tools.stress.subjects import Subject, subjects, swapped
from tactflow.vision import compiled


@pytest.fixture(scope="module")
def default() -> Subject:
    return subjects({"default": find_pipeline("default")})[0]


@pytest.mark.parametrize(
    ("errors", "level"),
    [
        ([0.1, 0.15, 0.25], 1.5),
        ([0.1, 0.2, 0.9], 1.0),
        ([0.1, 0.1, 0.1], None),
        ([0.1, None, 0.1], 1),
        ([None, 0.1, 0.9], None),
    ],
)
def test_an_error_doubles_where_it_crosses_twice_the_first_one(
    errors: list[float | None], level: float | None
) -> None:
    assert doubling([0, 1, 2], errors) == (pytest.approx(level) if level is not None else None)


def test_a_promise_is_broken_by_a_value_above_its_tolerance_and_the_script_breaks_none() -> None:
    checks = [
        Check("dots_drift", "default", 0.04),
        Check("dots_drift", "other", 0.06, "at rest"),
        Check("disc", "hull", 1, "radius 5 px"),
        Check("disc", "classic", 3, reference=True),
    ]
    report = Report(quick=True, machine={}, parts=[Part("Long run", "", checks=checks)])
    assert [(check.promise, check.subject) for check in report.broken] == [
        ("disc", "hull"),
        ("dots_drift", "other"),
    ]
    text = "\n".join(lines(report))
    assert "4 promises checked" not in text
    assert "3 promises checked, 2 broken" in text
    assert "at rest" in stress_page(report)


def test_counts_are_added_and_other_values_keep_the_worst() -> None:
    worst = Worst("hull")
    for where, value in (("a", 0), ("b", 1), ("c", 1)):
        worst.add("disc", value, where, count=True)
        worst.add("line", 0.1 * value, where)
    assert [(check.measured, check.where) for check in worst.checks()] == [(2, "b"), (0.1, "b")]


@pytest.mark.parametrize("name", TURNS)
def test_a_turn_takes_numbers_to_where_the_pictures_are(name: str) -> None:
    turn = TURNS[name]
    picture = np.zeros((30, 40, 3), np.uint8)
    picture[11, 17] = 1, 2, 3
    turned = turn.change(picture)
    # What is shifted is compared with the inner part of the picture.
    (row,), (column,) = np.nonzero(turned.any(axis=2))
    inner = 2.0 if name.startswith("shifted") else 0.0
    x, y = 17, 11
    at = {
        "decision": True,
        "center": [x - inner, y - inner],
        "area": 4.0,
        "flow": [1.0, 2.0],
        "flow_stderr": 0.0,
    }
    matrix = turn.matrix(40, 30)
    flow = (matrix[:2, :2] @ [1.0, 2.0]).tolist()
    there = {"decision": True, "center": [column, row], "area": 4.0, "flow": flow, "flow_stderr": 0.0}
    found = difference(at, there, matrix)
    assert max(found.values()) < 1e-9


def test_angles_turn_with_the_picture() -> None:
    one = {"decision": True, "angle": 30.0}
    other = {"decision": False, "angle": -60.0}
    matrix = TURNS["turned by 90 degrees"].matrix(40, 30)
    assert difference(one, other, matrix) == {"decision": 1.0, "angle": pytest.approx(0, abs=1e-9)}


def test_no_dot_can_be_known_better_than_noise_allows(default: Subject) -> None:
    case = cases_for(dots=True)[1]
    plain = clip(case)
    noisy = PERTURBATIONS["noise"].perturb(plain, 4.0, np.random.default_rng(0))
    bounds = [noise_bound(case, sigma, SEEN_RMS) for sigma in (2.0, 4.0)]
    assert bounds[0] is not None
    assert bounds[1] == pytest.approx(2 * bounds[0], rel=0.02)
    assert noise_bound(Case("press", 44), 4.0, "hull_iou") is None
    error = noisy.score(default.run(noisy.frames))[SEEN_RMS]
    assert bounds[1] < error < 4 * bounds[1]


def test_dirt_lies_on_the_lens_after_the_reference() -> None:
    plain = clip(Case("press", 44))
    dirty = PERTURBATIONS["dirt on the lens"].perturb(plain, 3, np.random.default_rng(0))
    assert all(np.array_equal(*pair) for pair in zip(plain.frames[:2], dirty.frames[:2], strict=True))
    for before, after in zip(plain.frames[2:], dirty.frames[2:], strict=True):
        assert (after <= before).all()
        share = (after + 1.0) / (before + 1.0)
        # Three specks, of which each takes more than half of the light within 4 px.
        assert 50 < np.count_nonzero(share.max(axis=2) < 0.5) < 3 * np.pi * 6**2


def test_a_picture_that_has_lost_its_colours_keeps_its_brightness() -> None:
    plain = clip(Case("press", 44))
    faded = PERTURBATIONS["less colour"].perturb(plain, 1.0, np.random.default_rng(0)).frames[2]
    assert np.ptp(faded, axis=2).max() == 0
    assert abs(faded[..., 0] - plain.frames[2].astype(float) @ (0.114, 0.587, 0.299)).max() < 0.6


def test_loops_are_strict_within_the_block_only() -> None:
    assert compiled.kernels()
    before = [loop.compiled for loop in compiled.kernels()]
    with strict():
        assert not any(loop.compiled is old for loop, old in zip(compiled.kernels(), before, strict=True))
    assert [loop.compiled for loop in compiled.kernels()] == before


def test_a_long_run_touches_the_gel_and_ends_at_rest(default: Subject) -> None:
    part = run_endurance([default], quick=True, length=200)
    assert part.trials == 200
    kept = {check.promise: check.kept for check in part.checks}
    assert kept.pop("memory") in (True, False)
    assert kept == dict.fromkeys(("false_at_rest", "held", "dots_drift", "center_drift", "area_drift"), True)
    assert len(list(frames(20, dots=True))) == 20


def test_answers_are_compared_with_those_of_another_run(default: Subject) -> None:
    part, answers = run_same([default], quick=True)
    assert [check for check in part.checks if not check.kept] == []
    (label,) = answers
    for frame in answers[label]:
        frame["dots"] = (np.asarray(frame["dots"]) + np.array([0.06, 0])).tolist()
    again, _ = run_same([default], quick=True, stored=answers)
    assert {check.promise for check in again.checks if not check.kept} == {"other_dots"}


def test_every_registered_alternative_takes_the_place_of_a_stage(default: Subject) -> None:
    names = [other.name for other in swapped(default)]
    assert {"tracker: lucas_kanade", "inpaint: telea", "hull: fit_line"} <= set(names)
    assert all(other.reference for other in swapped(default))


def test_the_page_has_a_plot_for_each_perturbation_and_json_has_all_numbers(tmp_path: Path) -> None:
    curves = [
        Curve(panel, "px", "center_error", "default, press", (0, 1), (0.1, 0.3), (0.01, 0.02))
        for panel in ("noise", "blur")
    ]
    report = Report(
        quick=False, machine={"CPU": "x"}, parts=[Part("Perturbation", "Text.", 7, curves=curves)]
    )
    written = stress_page(report)
    assert written.count("<figure>") == 2
    assert "Cramér-Rao" in written
    report.save(tmp_path / "stress.json")
    stored = json.loads((tmp_path / "stress.json").read_text())
    assert (stored["schema"], stored["trials"]) == ("tactflow.stress/1", 7)
    assert stored["parts"][0]["curves"][0]["errors"] == [0.1, 0.3]
    assert stored["promises"].keys() == PROMISES.keys()


def test_a_pipeline_that_breaks_a_promise_ends_with_code_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "shaky.py").write_text(
        "from tactflow import Stage\nfrom tactflow.ports import ContactMask\n"
        "from tactflow.vision.types import Contact\nimport numpy as np\n"
        "class Shaky(Stage):\n    memory = 'pure'\n"
        "    def process(self, contact_mask: ContactMask) -> Contact:\n"
        "        return Contact(float('nan'), (0.0, 0.0), None, None, np.zeros((0, 2)), None)\n"
    )
    (tmp_path / "shaky.yaml").write_text(
        "stages:\n  capture: {source: 'sim:press'}\n  preprocess: {}\n"
        "  difference: {in: {unmarked: preprocess.image}}\n  hull: {use: ./shaky.py}\n"
        "sinks:\n  jsonl: {path: out.jsonl}\n"
    )
    assert main(["stress", "shaky.yaml", "--quick", "--part", "degenerate"]) == 3
    assert "every number is finite and of the declared type" in capsys.readouterr().out
    assert (tmp_path / "stress.html").exists()
    stored = json.loads((tmp_path / "stress.json").read_text())
    checks = stored["parts"][0]["checks"]
    broken = [c for c in checks if c["measured"] > PROMISES[c["promise"]].tolerance and not c["reference"]]
    assert {check["subject"] for check in broken} == {"shaky"}
    assert {"hull", "difference", "tracker", "default"} <= {check["subject"] for check in checks}
    assert main(["stress", "--against", "shaky.yaml"]) == 2
    assert "shaky.yaml: not JSON" in capsys.readouterr().err
