"""What `import tactflow` offers: results in this process, single stages, mistakes as a list."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import tactflow

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


def test_importing_it_imports_neither_opencv_nor_numba() -> None:
    heavy = "{'cv2', 'numba', 'zmq', 'pydantic'}"
    code = f"import sys, tactflow; print({heavy} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "set()"


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
def test_leaving_the_loop_early_leaves_nothing_running() -> None:
    for result in tactflow.stream():
        if result.seq == 5:
            break
    assert not background()


@pytest.mark.usefixtures("folder")
def test_a_stream_that_is_never_looked_at_starts_nothing() -> None:
    tactflow.stream()
    assert not background()


@pytest.mark.usefixtures("folder")
def test_an_error_in_the_loop_leaves_nothing_running() -> None:
    with pytest.raises(ZeroDivisionError):
        sum(1 / (3 - result.seq) for result in tactflow.stream())
    assert not background()


@pytest.mark.usefixtures("folder")
def test_images_come_when_they_are_asked_for() -> None:
    (without,) = tactflow.stream(max_frames=1)
    (result,) = tactflow.stream(max_frames=1, images=True)
    assert without.image is None
    assert (without.frame.image.size, without.size) == (0, (300, 400))
    assert result.image is not None
    assert (result.frame.image.shape, result.image.shape) == ((600, 800, 3), (400, 300, 3))
    assert not result.frame.image.flags.writeable


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
    monkeypatch.setattr("tactflow.engine.run.CLOSE_SECONDS", 0.0)
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

    monkeypatch.setattr("tactflow.engine.run.make_schedule", fail)
    with pytest.raises(RuntimeError, match="not foreseen"):
        list(tactflow.stream())


@pytest.mark.usefixtures("folder")
def test_a_stage_may_be_called_stream() -> None:
    stage = {"use": "hull", "when": "touching"}
    settings = {"stages.hull": None, "stages.stream": stage}
    assert any(result.contact for result in tactflow.stream(settings=settings))


@pytest.mark.usefixtures("folder")
def test_arrays_of_a_result_cannot_be_written_to() -> None:
    result = next(r for r in tactflow.stream(images=True) if r.contact is not None)
    assert result.contact is not None
    assert result.markers is not None
    for array in (
        result.image,
        result.frame.image,
        result.contact_mask,
        result.contact.hull,
        result.markers.position,
    ):
        assert array is not None
        assert not array.flags.writeable


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

    monkeypatch.setattr("tactflow.engine.run.Runner._wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        tactflow.run()
    assert not background()


@pytest.mark.usefixtures("folder")
def test_a_mistake_in_the_pipeline_is_told_before_anything_starts() -> None:
    with pytest.raises(tactflow.ConfigError, match="min_area"):
        tactflow.stream(settings={"stages.hull.min_aera": 5})
    assert not background()


@pytest.mark.usefixtures("folder")
def test_check_lists_every_mistake() -> None:
    assert tactflow.check() == []
    mistakes = tactflow.check(settings={"stages.hull.min_aera": 5, "stages.inpaint.method": "glue"})
    assert len(mistakes) == 2


def test_a_stage_can_be_called_without_the_engine() -> None:
    hull = tactflow.stage("hull")
    assert hull.process(np.zeros((40, 40), np.uint8)) == tactflow.Absent("no_contact")
    with pytest.raises(tactflow.ConfigError, match=r"hull\.min_aera.* did you mean min_area"):
        tactflow.stage("hull", min_aera=3)
    with pytest.raises(tactflow.ConfigError, match="did you mean hull"):
        tactflow.stage("hul")


def test_a_stage_that_asks_for_more_than_its_parameters_gets_it(folder: Path) -> None:
    (folder / "named.py").write_text(
        "from tactflow import Stage\nfrom tactflow.ports import Image\n"
        "class Named(Stage):\n    memory = 'pure'\n"
        "    def __init__(self, params, sensor):\n        self.sensor = sensor\n"
        "    def process(self, image: Image) -> Image:\n        return image\n"
    )
    assert tactflow.stage("./named.py").sensor == "main"


def test_settings_may_be_paths_and_any_text(folder: Path) -> None:
    settings = {"stages.capture.source": folder / "\N{HERB}.npy", "sensor": "left"}
    pipeline = tactflow.load(settings=settings)
    assert pipeline.source.params.source.endswith("\N{HERB}.npy")  # type: ignore[attr-defined]


@pytest.mark.usefixtures("folder")
def test_settings_may_be_numbers_and_arrays_of_numpy() -> None:
    settings = {
        "skipping": np.bool_(False),
        "stages.hull.min_area": np.float32(5),
        "stages.preprocess.downsample": np.int64(1),
        "stages.preprocess.crop": np.array([0, 0, 400, 300]),
    }
    pipeline = tactflow.load(settings=settings)
    assert not pipeline.skipping
    preprocess, hull = (pipeline.nodes[id_].params.model_dump() for id_ in ("preprocess", "hull"))
    assert (preprocess["downsample"], list(preprocess["crop"])) == (1, [0, 0, 400, 300])
    assert hull["min_area"] == 5


def test_a_loaded_pipeline_can_be_streamed_twice(folder: Path) -> None:
    pipeline = tactflow.load(folder / "pipeline.yaml")
    first, second = (
        [r.contact.center for r in tactflow.stream(pipeline) if r.contact is not None] for _ in range(2)
    )
    assert first == second
    assert first
