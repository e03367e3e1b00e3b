"""`tactflow calibrate`, from a recording to results in millimetres, and what it says of a bad one."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

import tactflow
from tactflow.cli.main import main
from tactflow.sim import open_scene

RAW_MM = 0.025
"""Millimetres per raw pixel of the simulated gel, chosen so that its ball has a radius of 2.375 mm."""


def calibrate(*words: str) -> int:
    """Run the command."""
    return main(["calibrate", *words])


def test_a_newcomer_gets_millimetres_and_depth_within_their_stated_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    pitch = f"{open_scene('ball').layout.pitch * RAW_MM:.5f}"
    words = ["--from", "sim:ball?frames=240", "--pitch", pitch, "--ball-radius", "2.375"]
    assert calibrate(*words) == 0
    told = capsys.readouterr().err
    assert "press 8: radius" in told
    assert "calibration/main.yaml is written" in told
    said = yaml.safe_load(Path("calibration/main.yaml").read_text())
    assert said["made_from"] == "sim:ball?frames=240"
    assert said["photometric"]["presses"] >= 8

    settings = {"calibration": "calibration/main.yaml"}
    results = [r for r in tactflow.stream(source="sim:press?seed=11&frames=80", settings=settings) if r.depth]
    deepest = max(results, key=lambda result: result.depth.greatest if result.depth else 0.0)
    assert deepest.scale is not None
    assert deepest.depth is not None
    assert deepest.depth.greatest_stderr is not None
    assert abs(deepest.scale.x - 2 * RAW_MM) < 3 * deepest.scale.stderr[0]
    sunk = float(open_scene("press?seed=11&frames=80").truth(deepest.seq).sunk.max()) * RAW_MM
    assert abs(deepest.depth.greatest - sunk) < max(3 * deepest.depth.greatest_stderr, 0.03 * sunk)

    assert calibrate(*words) == 2
    assert "give --overwrite" in capsys.readouterr().err
    assert calibrate("check", "calibration/main.yaml", "--source", "sim:ball?frames=80&seed=2") == 0
    assert "it still fits" in capsys.readouterr().out
    assert calibrate("check", "calibration/main.yaml", "--source", "sim:round_gel?frames=3") == 3
    assert "calibrate anew" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--from", "sim:idle?frames=3"], "one of --pitch MM and --area"),
        (["markerless", "--from", "sim:unmarked?frames=3", "--pitch", "2"], "found 0"),
        (["--from", "sim:idle?frames=3", "--pitch", "2", "--ball-radius", "2"], "nothing touched the gel"),
        (["--from", "sim:idle?frames=3", "--pitch", "2", "--out", "a.txt"], "ends in .yaml"),
        (["--from", "sim:idle?frames=3", "--area", "0", "20"], "falls"),
        (["check", "nowhere.yaml", "--from", "sim:idle"], "nowhere.yaml"),
        (["check"], "required a calibration file"),
    ],
)
def test_what_gives_no_calibration_is_refused_in_words(
    words: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert calibrate(*words) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.yaml"))
