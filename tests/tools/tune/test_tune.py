"""`tune` chooses the cheapest pipeline that keeps the budget, and says what it cannot do."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

import tactflow
from tactflow.config.shipped import find_pipeline
from tactflow.tools.bench.scenes import Case
from tactflow.tools.tune import report, search, space
from tactflow.tools.tune.measure import Trial, judge, mark_unsound
from tactflow.tools.tune.recording import Recording, take
from tactflow.tools.tune.search import Goal, Tuned
from tactflow.tools.tune.sensor import Fitted, Look, fit
from tactflow.tools.tune.space import ORIGINAL, candidates, swaps
from tests.terminal import Terminal

SMALL = Look((320, 240), "markers=10x8", noise=2.0)
FIELD = {"field": {"field": {}, "mean": {"stages.field": None, "stages.flow_in_mask.method": "mean"}}}


def make_trial(name: str, ms: float, error: float, **more: object) -> Trial:
    trial = Trial(name, {}, tactflow.load("default"), {"center": error}, ms=ms)
    for key, value in more.items():
        setattr(trial, key, value)
    return trial


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A recording of a small sensor, taken for the default pipeline."""
    folder = tmp_path_factory.mktemp("recorded")
    path = Fitted(SMALL, Case("press", 30), folder, 3).path
    return take(str(path), tactflow.load("default"), folder)


def test_the_simulated_sensor_looks_like_the_recorded_one(recorded: Recording) -> None:
    look = fit(recorded)
    # The default pipeline turns the picture; the simulator's frames stay as wide as high as they were.
    assert look.size == (320, 240)
    assert look.noise == pytest.approx(SMALL.noise, rel=0.1)
    settings = dict(part.split("=") for part in look.query.split("&"))
    assert float(settings["pitch"]) == pytest.approx(69.0, rel=0.03)
    assert settings["polarity"] == "dark"
    assert look.levels == pytest.approx((1.0, 1.0, 1.0), abs=0.05)


def test_the_choice_keeps_the_budget_in_truth_and_nothing_cheaper_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, terminal: Terminal
) -> None:
    monkeypatch.setattr(space, "AXES", FIELD)
    monkeypatch.setattr(space, "swaps", lambda *_: [])
    monkeypatch.setattr(search, "SIMULATED_CASES", (Case("press", 24),))
    path = Fitted(SMALL, Case("press", 30), tmp_path, 3).path
    budget = 1.5
    words = ("tune", "default", "--source", str(path), "--max-error", str(budget), "--page", "tuned.html")
    assert terminal(*words) == 0
    trials = candidates(find_pipeline("default"), (320, 240), None)
    judge(trials, [Fitted(SMALL, Case("press", 24), tmp_path, 50)])
    truth = {trial.name: trial.error for trial in trials}
    # The mean over the dots is cheaper than the field, and far off: the budget forbids it.
    assert f"| CHOSEN | {ORIGINAL} " in terminal.out
    assert truth[ORIGINAL] <= budget < truth["mean"]
    assert "field" in tactflow.load("tuned.yaml").nodes
    page = Path("tuned.html").read_text(encoding="utf-8")
    assert "<td>mean</td>" in page
    assert '<b class="good">chosen</b>' in page
    text = Path("tuned.yaml").read_text()
    assert all(f"# {line}".rstrip() in text for line in terminal.out.splitlines())


def test_swaps_are_found_by_their_ports_and_keep_the_keys_of_the_file() -> None:
    found = {trial.name: trial for trial in swaps(find_pipeline("markerless"))}
    assert {"preprocess: pyramid", "difference: otsu", "hull: min_area_rect"} <= found.keys()
    otsu = found["difference: otsu"]
    # `shift`, which `otsu` does not have, is gone.
    kept = {"when": "suspect", "in": {"unmarked": "preprocess.image"}, "use": "otsu"}
    assert otsu.settings == {"stages.difference": kept}
    assert otsu.pipeline.nodes["difference"].component.name == "otsu"
    methods = {
        name for name in (trial.name for trial in swaps(find_pipeline("default"))) if "inpaint" in name
    }
    assert methods == {f"inpaint: {name}" for name in ("telea", "ns", "none", "frequency_selective")}


def test_only_swaps_that_gain_something_are_measured_in_full(
    recorded: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(search, "SIMULATED_CASES", (Case("press", 24),))
    monkeypatch.setattr(search, "FIRST_LOOK", Case("press", 12))
    original = Trial(ORIGINAL, {}, tactflow.load("default"))
    slower_and_worse = tactflow.load("default", settings={"stages.tracker": {"use": "classic_tracker"}})
    faster = tactflow.load("default", settings={"stages.fusion": None, "stages.field": None})
    tried = [Trial("slow", {"x": 1}, slower_and_worse), Trial("fast", {"x": 2}, faster)]
    told: list[str] = []

    def judge_with_given_times(trials: list[Trial], *rest: Any) -> dict[str, float]:
        """As `judge`, with times that do not depend on what else the machine does."""
        judge(trials, *rest)
        return {ORIGINAL: 2.0, "slow": 3.0, "fast": 1.0}

    monkeypatch.setattr(search, "judge", judge_with_given_times)
    tuned = search.search([original], recorded, tmp_path, Goal(), told.append, tried)
    assert {trial.name for trial in tuned.trials} == {ORIGINAL, "fast"}
    assert any("2 stages swapped, worth a closer look: fast" in line for line in told)


def test_the_order_follows_the_goal() -> None:
    trials = [
        make_trial("slow", 9, 0.1),
        make_trial("fast", 1, 2.0),
        make_trial("middle", 3, 0.5),
        make_trial("wrong", 0.5, 0.1, fault="% of dots lost: 50 (best 0)"),
        make_trial("fails", 0.1, 0.1, fault="tracker failed"),
    ]
    assert [trial.name for trial in Goal(max_error=1.0).order(trials)][:3] == ["middle", "slow", "fast"]
    assert [trial.name for trial in Goal(max_ms=4.0).order(trials)][:3] == ["middle", "fast", "slow"]
    # Without a budget: the cheapest of those that are nearly as exact as the best.
    assert Goal().order(trials)[0].name == "slow"


def test_an_impossible_budget_is_answered_with_what_is_possible(recorded: Recording) -> None:
    trials = [make_trial("exact", 9, 0.1), make_trial("fast", 1, 2.0)]
    possible = "Possible: 0.1 px in 9 ms (exact), or 2 px in 1 ms (fast)"
    assert Tuned(recorded, SMALL, trials).impossible().endswith(possible)


def test_a_pipeline_that_misses_contacts_is_not_sound() -> None:
    trials = [make_trial("good", 1, 1.0), make_trial("bad", 1, 0.1), make_trial("unknown", 1, math.inf)]
    trials[0].quantities = {"missed_half_depth": 0.0}
    trials[1].quantities = {"missed_half_depth": 40.0}
    mark_unsound(trials)
    assert [trial.usable for trial in trials] == [True, False, False]
    assert "40 (best 0)" in trials[1].fault


def test_the_file_lists_the_changes_and_lacks_removed_stages(recorded: Recording, tmp_path: Path) -> None:
    settings = {"stages.preprocess.downsample": 4, "stages.fusion": None, "skipping": False}
    pipeline = tactflow.load("default", settings=settings)
    chosen = make_trial("chosen", 1, 1, settings=settings, pipeline=pipeline)
    tuned = Tuned(recorded, SMALL, [chosen], chosen)
    text = report.pipeline_text(tuned, tmp_path / "tuned.yaml")
    assert "# stages.preprocess.downsample: 4" in text
    assert "# stages.fusion: removed" in text
    document = yaml.safe_load(text)
    assert document["stages"]["preprocess"]["downsample"] == 4
    assert "fusion" not in document["stages"]
    assert document["skipping"] is False


def test_no_line_of_a_recordings_name_becomes_part_of_the_pipeline(
    recorded: Recording, tmp_path: Path
) -> None:
    odd = replace(recorded, source="press\nsinks:\u2028evil: {}\n.npy")
    chosen = make_trial("chosen", 1, 1)
    tuned = Tuned(odd, SMALL, [chosen], chosen)
    text = report.pipeline_text(tuned, tmp_path / "tuned.yaml")
    assert yaml.safe_load(text) == yaml.safe_load(find_pipeline("default").read_text())
    assert "# sinks:" in text


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["--source", "still"], 4, "no contact in the first 24 frames"),
        (["--source", "short"], 4, "5 frames are too few"),
        (["--source", "nowhere.avi"], 4, "no such file"),
        (["--source", "still", "--max-error", "-1"], 2, "required a number above 0"),
        (["--source", "still", "--out", "tuned.txt"], 2, "ends in .yaml"),
        (["--source", "still", "--out", "readonly/tuned.yaml"], 2, "readonly cannot be written into"),
    ],
)
def test_unusable_recordings_and_options_are_rejected(
    arguments: list[str],
    code: int,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    terminal: Terminal,
) -> None:
    # Of a user who may do everything too.
    monkeypatch.setattr(os, "access", lambda path, _mode: Path(path).name != "readonly")
    (tmp_path / "readonly").mkdir()
    for name, count in (("still", 24), ("short", 5)):
        (tmp_path / name).mkdir()
        for index in range(count):
            gel = np.full((60, 80, 3), 120, np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{index:02}.png"), gel)
    assert terminal("tune", "markerless", *arguments) == code
    assert says in terminal.err


def test_the_original_is_one_row_and_stays_where_flow_cannot_be_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(space, "AXES", FIELD)
    monkeypatch.setattr(search, "SIMULATED_CASES", (Case("press", 24),))
    # So large a pitch that no dot lies within the contact.
    look = Look((320, 240), "markers=3x2&pitch=260", noise=2.0)
    monkeypatch.setattr(search, "fit", lambda _: look)
    recording = take(
        str(Fitted(look, Case("press", 30), tmp_path, 3).path), tactflow.load("default"), tmp_path
    )
    trials = candidates(find_pipeline("default"), (320, 240), None)
    assert [trial.name for trial in trials] == [ORIGINAL, "mean"]
    tuned = search.search(trials, recording, tmp_path, Goal())
    assert [trial.usable for trial in tuned.trials] == [True, False]
    assert tuned.chosen is not None
    assert tuned.chosen.name == ORIGINAL
