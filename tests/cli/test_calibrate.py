"""`tactflow calibrate`, from a recording to results in millimetres, and what it says of a bad one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import tactflow
from tactflow.sim import open_scene
from tests.terminal import Terminal

RAW_MM = 0.025
"""Millimetres per raw pixel of the simulated gel, chosen so that its ball has a radius of 2.375 mm."""


def test_a_newcomer_gets_millimetres_and_depth_within_their_stated_errors(terminal: Terminal) -> None:
    pitch = f"{open_scene('ball').layout.pitch * RAW_MM:.5f}"
    words = ["--from", "sim:ball?frames=200", "--pitch", pitch, "--ball-radius", "2.375"]
    assert terminal("calibrate", *words) == 0
    output = terminal.err
    assert "press 8 of 30: good, radius" in output
    assert "calibration/main.yaml is written" in output
    assert "core_area: 1.0" in output
    stored = yaml.safe_load(Path("calibration/main.yaml").read_text())
    assert stored["made_from"] == "sim:ball?frames=200"
    assert stored["photometric"]["presses"] >= 8

    settings = {"calibration": "calibration/main.yaml"}
    results = [r for r in tactflow.stream(source="sim:press?seed=11&frames=80", settings=settings) if r.depth]
    deepest = max(results, key=lambda result: result.depth.greatest if result.depth else 0.0)
    assert deepest.scale is not None
    assert deepest.depth is not None
    assert deepest.depth.greatest_stderr is not None
    assert abs(deepest.scale.x - 2 * RAW_MM) < 3 * deepest.scale.stderr[0]
    sunk = float(open_scene("press?seed=11&frames=80").truth(deepest.seq).sunk.max()) * RAW_MM
    assert abs(deepest.depth.greatest - sunk) < max(3 * deepest.depth.greatest_stderr, 0.03 * sunk)

    scene = "ball?frames=100&shear=0.6"
    assert terminal("sim", scene, "--truth", "gauge.csv", "--quiet") == 0
    force = ["force", "calibration/main.yaml", "--from", f"sim:{scene}", "--csv", "gauge.csv"]
    assert terminal("calibrate", *force) == 0
    output = terminal.err
    assert "heights are not known" not in output
    assert "the gauge's x axis lies -90 degrees" in output
    assert terminal("calibrate", "check", *force[1:]) == 0
    assert "N RMS from the gauge today; when it was made" in terminal.out
    assert terminal("calibrate", *force) == 2
    assert "has a force already" in terminal.err
    spec = "ball?frames=60&shear=0.6&seed=3"
    felt = [r for r in tactflow.stream(source=f"sim:{spec}", settings=settings) if r.force]
    forces = np.array([result.force.value for result in felt if result.force], float)
    assert np.isfinite(forces).any(axis=0).all()

    assert terminal("calibrate", *words) == 2
    assert "give --overwrite" in terminal.err
    assert (
        terminal("calibrate", "check", "calibration/main.yaml", "--source", "sim:ball?frames=60&seed=2") == 0
    )
    assert "it still fits" in terminal.out
    assert terminal("calibrate", "check", "calibration/main.yaml", "--source", "sim:round_gel?frames=3") == 3
    output = terminal.out
    assert "another sensor or light, or an object on the gel at the start" in output
    assert "calibrate again" in output
    # One press of another ball is no drift.
    assert terminal("calibrate", "check", "calibration/main.yaml", "--source", "sim:finger?frames=12") == 3
    output = terminal.out
    assert "presses today, 1: " in output
    assert "a ball whose radius is not 2.375 mm" in output
    assert terminal("calibrate", "check", "calibration/main.yaml", "--source", "sim:idle?frames=3") == 0
    assert "no presses today: to check the depth" in terminal.out


@pytest.mark.parametrize(("rows_apart", "warned"), [(30, False), (28, True)])
def test_a_scale_from_an_irregular_grid_is_reported_as_inaccurate(
    rows_apart: int, warned: bool, terminal: Terminal
) -> None:
    picture = np.full((240, 320, 3), 150, np.uint8)
    for x, y in np.ndindex(10, 7):
        cv2.circle(picture, (25 + 30 * x, 25 + rows_apart * y), 5, (30, 30, 30), -1, cv2.LINE_AA)
    cv2.imwrite("gel.png", picture)
    options = ["--pitch", "3", "--gel-thickness", "2.5"]
    assert terminal("calibrate", "mini", "--from", "gel.png", *options) == 0
    output = terminal.err
    assert yaml.safe_load(Path("calibration/mini.yaml").read_text())["gel_thickness"] == 2.5
    assert ("--pitch is for dots in a square grid" in output) == warned


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--from", "sim:idle?frames=3"], "one of --pitch MM and --area"),
        (["markerless", "--from", "sim:unmarked?frames=3", "--pitch", "2"], "found 0"),
        # No page in this pipeline: it gets one.
        (["markerless", "--from", "sim:unmarked?frames=3", "--pitch", "2", "--view"], "view: http://"),
        (["--from", "sim:idle?frames=3", "--pitch", "2", "--ball-radius", "2"], "nothing touched the gel"),
        (["--from", "sim:idle?frames=3", "--pitch", "2", "--out", "a.txt"], "ends in .yaml"),
        (["--from", "sim:idle?frames=3", "--area", "0", "20"], "--area: required millimetres from 0.001"),
        (["check", "nowhere.yaml", "--from", "sim:idle"], "nowhere.yaml"),
        (["force"], "required a calibration file"),
        (["force", "nowhere.yaml", "--from", "sim:idle"], "nowhere.yaml"),
    ],
)
def test_unusable_options_and_recordings_are_rejected(
    words: list[str], message: str, tmp_path: Path, terminal: Terminal
) -> None:
    assert terminal("calibrate", *words) == 2
    assert message in terminal.err
    assert not list(tmp_path.rglob("*.yaml"))


def test_a_scale_asks_for_no_presses_and_a_live_source_ends_by_itself(terminal: Terminal) -> None:
    assert (
        terminal("calibrate", "--from", "sim:ball?frames=60", "--pitch", "1.724", "--out", "film.yaml") == 0
    )
    output = terminal.err
    assert "press 1" not in output
    assert "--set calibration=film.yaml" in output
    assert terminal("calibrate", "check", "film.yaml", "--from", "sim:ball?frames=2") == 0
    assert "tactflow: INFO: 800 x 600 becomes 300 x 400" in terminal.err
    # As a camera, for ten minutes, unless it ends when it knows what it needs.
    live = ["--from", "sim:idle?frames=36000", "--realtime", "--pitch", "1.724", "--out", "camera.yaml"]
    assert terminal("calibrate", *live) == 0
    assert "Leave the gel untouched." in terminal.err
    scales = [yaml.safe_load(Path(name).read_text())["scale"] for name in ("film.yaml", "camera.yaml")]
    assert scales[0]["mm_per_pixel"] == pytest.approx(scales[1]["mm_per_pixel"], rel=5e-3)


REFINED = """
sensor: left
calibration: kind.yaml
stages:
  capture: {source: "0"}
  preprocess: {rotate: 90, downsample: 2}
  marker_mask:
  inpaint:
  difference:
  tracker:
  untouched:
  scale:
  hull: {when: touching}
  depth: {when: touching}
sinks:
  jsonl: {path: out.jsonl}
"""


def test_the_default_of_a_kind_of_sensor_is_refined_by_two_pictures_of_one_press(terminal: Terminal) -> None:
    ball = ["--ball-radius", "2.375"]
    pitch = f"{open_scene('ball').layout.pitch * RAW_MM:.5f}"
    words = ["--from", "sim:ball?frames=200", "--pitch", pitch, "--out", "kind.yaml"]
    assert terminal("calibrate", *words, *ball) == 0
    kind = yaml.safe_load(Path("kind.yaml").read_text()) | {"kind": "test gel"}
    kind["photometric"] |= {"depth_stderr": 0.11, "between": 0.102}
    Path("kind.yaml").write_text(yaml.safe_dump(kind))

    Path("left.yaml").write_text(REFINED)
    scene = open_scene("ball?frames=200&seed=4")
    Path("pictures").mkdir()
    # Two depths at one place, without a picture of the untouched gel between them.
    depths = [max((press.depth for press in scene.presses(index)), default=0.0) for index in range(40)]
    deepest = int(np.argmax(depths))
    going_down = [np.searchsorted(depths[: deepest + 1], part * depths[deepest]) for part in (0.4, 1)]
    for number, index in enumerate((0, *going_down)):
        cv2.imwrite(f"pictures/{number}.png", scene.frame(int(index)))
    refine = ["left.yaml", "--from", "pictures", "--refine"]
    assert terminal("calibrate", *refine) == 2
    assert "required --ball-radius MM" in terminal.err
    assert terminal("calibrate", *refine, *ball) == 0
    output = terminal.err
    assert "2 presses; learning" in output
    assert "press 1 of 9" in output
    assert "not its diameter" not in output
    found = yaml.safe_load(Path("calibration/left.yaml").read_text())
    assert found.get("kind") is None
    assert found["scale"] == kind["scale"]
    assert found["photometric"]["presses"] == 2
    assert found["photometric"]["depth_stderr"] < 0.8 * kind["photometric"]["depth_stderr"]

    Path("left.yaml").write_text(REFINED.replace("rotate: 90", "rotate: 270"))
    assert terminal("calibrate", *refine, *ball, "--overwrite") == 2
    assert "does not fit: the frames are turned" in terminal.err
    Path("left.yaml").write_text(REFINED.replace("calibration: kind.yaml", ""))
    assert terminal("calibrate", *refine, *ball, "--overwrite") == 2
    assert "since the pipeline has no calibration" in terminal.err


def test_a_recording_that_no_force_can_be_learned_from_is_left_out_by_name(terminal: Terminal) -> None:
    assert terminal("calibrate", "--from", "sim:idle?frames=3", "--pitch", "1.724", "--out", "gel.yaml") == 0
    Path("forces").mkdir()
    for name, scene in (
        ("good", "ball?frames=100&shear=0.6"),
        ("idle", "idle?frames=12"),
        ("bad", "ball?frames=12"),
    ):
        assert terminal("sim", scene, "--truth", f"forces/{name}.csv", "--quiet") == 0
        recorded = ["--source", f"sim:{scene}", "--out", f"forces/{name}.mcap", "--set", "sinks={}"]
        assert terminal("record", "markerless", *recorded, "--quiet") == 0
    Path("forces/bad.csv").write_text("t,force\n0,1\n")
    assert terminal("calibrate", "force", "gel.yaml", "--from", "forces") == 0
    output = terminal.err
    assert "forces/idle.mcap is left out: " in output
    assert "forces/bad.mcap is left out: " in output
    assert "forces/good.mcap: 100 frames" in output
    assert list(yaml.safe_load(Path("gel.yaml").read_text())["force"]["recordings"]) == ["forces/good.mcap"]
    Path("forces/good.csv").unlink()
    assert terminal("calibrate", "force", "gel.yaml", "--from", "forces", "--overwrite") == 2
    assert "none of the 2 recordings can be used" in terminal.err


def test_weights_on_the_gel_give_newtons_without_a_gauge(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = open_scene("ball?frames=100")
    firm = (12, 18, 40, 62)
    newtons = [float(scene.truth(index).force[2]) for index in firm]
    rest = scene.frame(0)[::2, ::2]
    frames = [rest] * 4
    for index in firm:
        frames += [scene.frame(index)[::2, ::2]] * 9 + [rest] * 3
    np.save("loads.npy", np.array(frames))
    assert terminal("pipelines", "markerless") == 0
    pipeline = yaml.safe_load(terminal.out)
    pipeline["stages"]["capture"] |= {"source": "loads.npy", "fps": 8}
    Path("slow.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    source = ["slow.yaml"]
    assert terminal("calibrate", *source, "--area", "15", "20", "--out", "gel.yaml") == 0
    grams = [f"{force / 9.80665e-3:.2f}" for force in newtons]
    weigh = ["force", "gel.yaml", *source, "--weights"]
    assert terminal("calibrate", *weigh, *grams[:-1]) == 2
    assert f"got {len(firm) - 1} weights, and found {len(firm)} loads" in terminal.err
    assert terminal("calibrate", *weigh, *grams) == 0
    assert f"Put {float(grams[1]):.0f} g on the gel" in terminal.err
    assert f"{len(firm)} loads: RMS error" in terminal.err
    stored = yaml.safe_load(Path("gel.yaml").read_text())["force"]
    assert stored["left_out"] == "load"
    assert stored["press"]["range"] == pytest.approx([min(newtons), max(newtons)], rel=1e-3)
    check = ["check", *weigh[1:]]
    assert terminal("calibrate", *check, *grams) == 0
    assert "it still fits" in terminal.out
    twice = [str(2 * float(weight)) for weight in grams]
    assert terminal("calibrate", *check, *twice, "--overwrite") == 3
    assert "standard errors of the force are wider by as much" in terminal.out
    assert yaml.safe_load(Path("gel.yaml").read_text())["force"]["drift"] == pytest.approx(1, abs=0.2)
    settings = {"calibration": "gel.yaml", "sinks": {}}
    felt = [r.force for r in tactflow.stream("slow.yaml", settings=settings) if r.force]
    assert felt
    assert not any(force.as_calibrated for force in felt)
    assert terminal("calibrate", *source, "--area", "15", "20", "--out", "second.yaml") == 0
    like = ["force", "second.yaml", *source, "--like", "gel.yaml"]
    assert terminal("calibrate", *like) == 2
    assert "required --weights, two or more" in terminal.err
    # What cannot work is said before anything is put on the gel.
    for words, problem in (
        (["force", "second.yaml", *source, "--like", "second.yaml", "--weights", *twice], "has no force"),
        (["check", "second.yaml", *source, "--weights", *twice], "second.yaml has no force"),
        ([*like, "--weights", "100"], "required 2 weights or more, got 1"),
        (["force", "second.yaml", *source, "--weights", "100", "200"], "required 3 weights or more, got 2"),
        ([*like, "--csv", "a.csv", "--weights", *twice], "--weights and --csv both give the forces"),
    ):
        assert terminal("calibrate", *words) == 2
        assert problem in terminal.err
        assert "on the gel, and let go" not in terminal.err
    Path("pictures").mkdir()
    for number, frame in enumerate(frames[:2]):
        cv2.imwrite(f"pictures/{number}.png", frame)
    assert terminal("calibrate", *like, "--from", "pictures", "--weights", *twice) == 2
    assert "tactflow: calibrate --weights: pictures that were taken one by one" in terminal.err
    assert terminal("calibrate", *like, "--weights", *twice) == 0
    carried = yaml.safe_load(Path("second.yaml").read_text())["force"]
    assert carried["press"]["range"] == pytest.approx(
        [2 * limit for limit in stored["press"]["range"]], rel=0.1
    )
    assert carried["drift"] == 0
    assert terminal("calibrate", *weigh) == 2
    assert "has a force already" in terminal.err
    assert terminal("calibrate", *weigh[:-1], "--overwrite", "--weights") == 2
    assert "required the weights in g" in terminal.err
    # Readings of a scale are asked for in the end; without one, a load is left out.
    readings = iter([grams[0], "heavy", grams[1], "", grams[3]])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda _: next(readings))
    assert terminal("calibrate", *weigh[:-1], "--overwrite", "--weights") == 0
    assert "write down what the scale reads" in terminal.err
    assert "got 'heavy'" in terminal.err
    assert "3 loads: RMS error" in terminal.err
    # The end of the input leaves out the rest.
    readings = iter(grams[:3])

    def read(_: str) -> str:
        for reading in readings:
            return reading
        raise EOFError

    monkeypatch.setattr("builtins.input", read)
    assert terminal("calibrate", *weigh[:-1], "--overwrite", "--weights") == 0
    assert "3 loads: RMS error" in terminal.err
