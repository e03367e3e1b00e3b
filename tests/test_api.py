"""What `import tactflow` offers: results in this process, single stages, functions for a notebook."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tactflow
from tactflow.ports import Image
from tests.paths import REPOSITORY

PIPELINE = """
stages:
  capture: {source: "sim:press?frames=60"}
  preprocess: {rotate: 90, downsample: 2}
  marker_mask:
  inpaint:
  difference:
  hull: {when: touching}
  tracker:
  flow_in_mask: {when: touching}
sinks:
  jsonl: {path: out.jsonl, detail: true}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with pipeline.yaml, which is the current one."""
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def background() -> list[str]:
    """The threads of tactflow that run."""
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("tactflow")]


def test_every_public_name_is_there_and_nothing_else() -> None:
    assert sorted(tactflow.__all__) == sorted(tactflow._HOME)
    for name in tactflow.__all__:
        assert getattr(tactflow, name).__name__ == name
    with pytest.raises(AttributeError, match=r"tactflow has no steam; public are .* stream"):
        tactflow.steam  # noqa: B018


def test_a_stream_gives_what_the_pipeline_writes(folder: Path) -> None:
    tactflow.run(source="sim:press?frames=60")
    written = (folder / "out.jsonl").read_text().splitlines()
    streamed = list(tactflow.stream())
    assert [result.seq for result in streamed] == list(range(60))
    assert any(result.contact is not None for result in streamed)
    for result, line in zip(streamed, written, strict=True):
        assert result.to_dict(detail=True) == json.loads(line)


def test_a_stream_writes_no_file_unless_asked_to(folder: Path) -> None:
    assert len(list(tactflow.stream(max_frames=3))) == 3
    assert not (folder / "out.jsonl").exists()
    assert len(list(tactflow.stream(max_frames=3, sinks=True))) == 3
    assert len((folder / "out.jsonl").read_text().splitlines()) == 3


@pytest.mark.usefixtures("folder")
def test_a_loop_that_is_left_never_entered_or_fails_leaves_nothing_running() -> None:
    tactflow.stream()
    assert not background()
    for result in tactflow.stream():
        if result.seq == 5:
            break
    assert not background()
    with pytest.raises(ZeroDivisionError):
        sum(1 / (3 - result.seq) for result in tactflow.stream())
    assert not background()


@pytest.mark.usefixtures("folder")
def test_images_come_when_they_are_asked_for_and_no_array_can_be_written_to() -> None:
    (without,) = tactflow.stream(max_frames=1)
    assert without.image is None
    assert (without.frame.image.size, without.size) == (0, (300, 400))
    result = next(r for r in tactflow.stream(images=True) if r.contact is not None)
    assert result.image is not None
    assert (result.frame.image.shape, result.image.shape) == ((600, 800, 3), (400, 300, 3))
    assert result.contact is not None
    assert result.markers is not None
    arrays = (result.image, result.frame.image, result.contact_mask, result.contact.hull)
    for array in (*arrays, result.markers.position):
        assert array is not None
        assert not array.flags.writeable


@pytest.mark.usefixtures("folder")
def test_of_a_live_source_a_slow_loop_gets_the_newest_results() -> None:
    stream = tactflow.stream(source="sim:press?frames=100000", realtime=True)
    seqs = [next(stream).seq]
    # Until the loop was slower than the source, however slow the machine is.
    while seqs[-1] - seqs[0] < len(seqs):
        threading.Event().wait(0.1 * len(seqs))
        seqs.append(next(stream).seq)
        assert len(seqs) < 30
    stream.close()
    assert seqs == sorted(set(seqs))
    assert not background()


@pytest.mark.usefixtures("folder")
def test_a_loop_may_take_its_time_at_the_end_of_a_recording(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tactflow.engine.threads.CLOSE_SECONDS", 0.0)
    seqs = []
    for result in tactflow.stream(max_frames=4):
        # Longer than a run looks on before it calls something hanging.
        threading.Event().wait(0.7)
        seqs.append(result.seq)
    assert seqs == [0, 1, 2, 3]


@pytest.mark.usefixtures("folder")
def test_an_unforeseen_error_reaches_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("not foreseen")

    monkeypatch.setattr("tactflow.engine.threads.Segment", fail)
    with pytest.raises(RuntimeError, match="not foreseen"):
        list(tactflow.stream())


@pytest.mark.usefixtures("folder")
def test_a_source_that_fails_raises_in_the_loop() -> None:
    with pytest.raises(tactflow.TactflowError, match=r"nowhere\.avi"):
        list(tactflow.stream(source="nowhere.avi"))
    with pytest.raises(tactflow.TactflowError, match=r"nowhere\.avi"):
        tactflow.run(source="nowhere.avi")


@pytest.mark.usefixtures("folder")
def test_an_interrupt_reaches_who_has_started_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tactflow.engine.threads.Threads.wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tactflow.run()
    assert not background()


@pytest.mark.usefixtures("folder")
def test_mistakes_in_the_pipeline_are_told_before_anything_starts() -> None:
    with pytest.raises(tactflow.ConfigError, match="min_area"):
        tactflow.stream(settings={"stages.hull.min_aera": 5})
    assert not background()
    assert tactflow.check() == []
    mistakes = tactflow.check(settings={"stages.hull.min_aera": 5, "stages.inpaint.method": "glue"})
    assert len(mistakes) == 2


OWN = """
from typing import NamedTuple
from tactflow import Stage, StageParams
from tactflow.ports import Image

class Outputs(NamedTuple):
    brightness: float

class Own(Stage):
    memory = "pure"
    class Params(StageParams):
        gain: float = 1.0
    def __init__(self, params, sensor):
        self.sensor = sensor
    def process(self, image: Image) -> Outputs:
        return Outputs(self.params.gain * float(image.mean()))
"""


def test_the_output_of_ones_own_stage_is_in_the_result(folder: Path) -> None:
    (folder / "own.py").write_text(OWN)
    own = {"stages.own": {"use": "./own.py"}}
    results = list(tactflow.stream(settings=own, images=True, max_frames=3))
    assert all(r.image is not None and r["brightness"] == r.image.mean() for r in results)
    with pytest.raises(KeyError, match=r"no stage gives the port brightnes; there are .*brightness"):
        results[0]["brightnes"]
    assert list(tactflow.to_frame(results)["brightness"]) == [r["brightness"] for r in results]


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize("form", [np.asarray, list, iter, lambda frames: frames[..., 1]])
def test_frames_in_memory_are_a_source(form: Callable[[np.ndarray], Iterable[np.ndarray]]) -> None:
    scene = tactflow.open_scene("press")
    frames = np.stack([scene.frame(index) for index in range(40)])
    results = list(tactflow.stream(source=form(frames), settings={"stages.capture.fps": 10}))
    assert [result.t for result in results] == [index / 10 for index in range(40)]
    assert results[0].contact is None
    assert results[-1].contact is not None


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    ("source", "words"),
    [
        (np.zeros((48, 64, 3), np.uint8), r"required uint8 or uint16 of N x H x W x 3 .* give array\[None\]"),
        (["a.png", "b.png"], "picture 0: required an array"),
    ],
)
def test_what_is_no_sequence_of_pictures_is_refused(source: Any, words: str) -> None:
    with pytest.raises(tactflow.TactflowError, match=f"(?i){words}"):
        next(tactflow.stream(source=source))


def test_a_stage_can_be_called_without_the_engine() -> None:
    hull = tactflow.stage("hull", min_area=3)
    assert hull.params.min_area == 3
    assert hull.process(np.zeros((40, 40), np.uint8)) == tactflow.Absent("no_contact")
    with pytest.raises(tactflow.ConfigError, match=r"hull\.min_aera.* did you mean min_area") as caught:
        tactflow.stage("hull", min_aera=3)
    assert "--set" not in str(caught.value)
    with pytest.raises(tactflow.ConfigError, match="did you mean hull"):
        tactflow.stage("hul")


def test_a_stage_that_compares_with_a_reference_takes_pictures() -> None:
    scene = tactflow.open_scene("press")
    difference = tactflow.stage("difference")
    touching = [difference.process(scene.frame(index)).touching for index in (0, 1, 48)]
    assert touching == [False, False, True]
    everywhere = np.full((600, 800), 255, np.uint8)
    assert difference.process(scene.frame(49), valid=everywhere).touching
    small = tactflow.stage("preprocess", rotate=90, downsample=2).process(scene.frame(0)).image
    assert small.shape == (400, 300, 3)


def test_every_stage_keeps_its_parameters(folder: Path) -> None:
    (folder / "own.py").write_text(OWN)
    own = tactflow.stage("./own.py")
    assert (own.sensor, own.params.gain) == ("main", 1.0)
    uses = [entry.name for entry in entry_points(group="tactflow.stages")]
    # One is a source, the other needs a file.
    for use in {*uses, "tracker", "difference", "hull"} - {"capture", "network"}:
        assert isinstance(tactflow.stage(use).params, tactflow.StageParams), use


def test_a_stage_class_can_be_called_too() -> None:
    class Invert(tactflow.Stage):
        memory = "pure"

        class Params(tactflow.StageParams):
            strength: float = 1.0

        def process(self, image: Image) -> Image:
            return np.rint(image + self.params.strength * (255.0 - 2 * image)).astype(np.uint8)

    assert tactflow.stage(Invert).process(np.zeros((2, 2, 3), np.uint8)).min() == 255
    with pytest.raises(tactflow.ConfigError, match=r'stage\("Invert"\).*strengh.* did you mean strength'):
        tactflow.stage(Invert, strengh=0.5)


# -- for a notebook ---------------------------------------------------------------------------------------


def test_functions_for_a_notebook_take_pictures() -> None:
    scene = tactflow.open_scene("press")
    reference, image = scene.frame(0), scene.frame(48)
    assert len(tactflow.detect_markers(reference).centers) == 80
    markers = tactflow.MarkerTracker(reference).track(image)
    assert np.hypot(*markers.displacement.T).max() > 5
    contact = tactflow.contact(image, reference)
    assert contact is not None
    assert contact.area > 1000
    assert tactflow.contact(scene.frame(1), reference) is None
    with pytest.raises(ValueError, match="pictures of one shape"):
        tactflow.contact(image[:100], reference)


@pytest.mark.usefixtures("folder")
def test_a_result_can_be_drawn() -> None:
    result = next(r for r in tactflow.stream(images=True) if r.contact is not None)
    picture = tactflow.draw(result, arrow_scale=1)
    assert result.image is not None
    assert picture.shape == result.image.shape
    assert (picture != result.image).any()
    sideways = np.zeros(result.image.shape, np.float32) + np.float32([1, 0, 0])
    tilted = tactflow.draw(result.replace(normals=sideways), view="normals", text=False)
    assert tilted[0, 0].tolist() == [128, 128, 255]
    with pytest.raises(ValueError, match="images=True"):
        tactflow.draw(next(tactflow.stream()))


@pytest.mark.usefixtures("folder")
def test_results_are_a_table() -> None:
    results = list(tactflow.stream())
    table = tactflow.to_frame(results)
    assert list(table["seq"]) == list(range(60))
    areas = [result.contact.area for result in results if result.contact is not None]
    assert list(table["contact_area"].dropna()) == areas
    assert {"flow_mean_x", "flow_stderr_x", "size_width"} <= set(table.columns)


def test_without_pandas_the_table_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install 'tactflow\[pandas\]'"):
        tactflow.to_frame([])


SCRIPT = """
from typing import NamedTuple

import numpy as np
from pydantic import Field

import tactflow
from tactflow.ports import Image


class Outputs(NamedTuple):
    brightness: float


class Brightness(tactflow.Stage):
    memory = "pure"

    class Params(tactflow.StageParams):
        gain: float = Field(1.0, gt=0)

    def process(self, image: Image) -> Outputs:
        return Outputs(float(image.mean()) * float(self.params.gain))


class Print(tactflow.Sink):
    def write(self, result: tactflow.Result) -> None:
        print(result.seq, result.contact and result.contact.area)


def largest(frames: list[Image]) -> float:
    results = tactflow.stream(source=frames, images=True, settings={"stages.hull.min_area": 5})
    areas = [result.contact.area for result in results if result.contact is not None]
    return max(areas, default=0.0)


stage = tactflow.stage(Brightness, gain=2.0)
value: float = stage.process(np.zeros((2, 2, 3), np.uint8)).brightness
contact: tactflow.Contact | None = tactflow.contact(np.zeros((2, 2), np.uint8), np.zeros((2, 2), np.uint8))
with tactflow.Subscriber(timeout=1) as results:
    for result in results:
        print(result.flow and result.flow.mean, tactflow.draw(result).shape, result.to_json())
tactflow.to_frame(tactflow.stream()).describe()
"""


def test_mypy_is_content_with_a_users_program(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    readme = re.search(r"```python\n(# bright.py.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert readme is not None
    (tmp_path / "bright.py").write_text(readme[1])
    (tmp_path / "wrong.py").write_text('import tactflow\n\ntactflow.stage("hull").proces\n')
    files = ("script.py", "bright.py", "wrong.py")
    # What it has learned of the packages is kept for the next time.
    cache = ("--cache-dir", str(REPOSITORY / ".mypy_cache" / "users"))
    done = subprocess.run(
        [*(sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent"), *cache, *files],
        cwd=tmp_path,
        env=os.environ | {"MYPYPATH": str(REPOSITORY / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert 'wrong.py:3: error: "Stage" has no attribute "proces"' in done.stdout
    assert "Found 1 error in 1 file (checked 3 source files)" in done.stdout


# -- settings ---------------------------------------------------------------------------------------------


def test_nested_settings_of_stages_are_merged_with_those_of_the_file() -> None:
    settings = {"stages": {"hull": {"min_area": 7}, "force": None, "preprocess": {}}, "sinks": {}}
    nested = tactflow.load("default", settings=settings)
    dotted = tactflow.load(
        "default",
        settings={"stages.hull.min_area": 7, "stages.force": None, "stages.preprocess": {}, "sinks": {}},
    )
    assert nested.settings == dotted.settings
    assert nested.nodes["hull"].params.min_area == 7  # type: ignore[attr-defined]


def test_settings_may_be_numbers_of_numpy() -> None:
    settings = {"skipping": np.bool_(False), "stages.hull.min_area": np.float32(5)}
    pipeline = tactflow.load("default", settings=settings)
    assert (pipeline.skipping, pipeline.nodes["hull"].params.min_area) == (False, 5)  # type: ignore[attr-defined]


def test_a_loaded_pipeline_can_be_streamed_twice(folder: Path) -> None:
    pipeline = tactflow.load(folder / "pipeline.yaml")
    first, second = (
        [r.contact.center for r in tactflow.stream(pipeline) if r.contact is not None] for _ in range(2)
    )
    assert first == second
    assert first
