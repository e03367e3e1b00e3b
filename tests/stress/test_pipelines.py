"""Whole pipelines, through the real engine with every port checked: what follows, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override
from tactflow.engine.run import Runner, RunResult
from tests.stress.builders import (
    DOUBLED,
    MIRRORS,
    ROTATIONS,
    SIZE,
    Image,
    Points,
    Transformation,
    apart,
    assert_defined,
    axis_difference,
    gel,
    matched,
)

REPOSITORY = Path(__file__).resolve().parents[2]
PIPELINES = ("default", "classic", "markerless")
FOLLOWING = ("default", "markerless")
"""Pipelines whose stages scale and turn; the script's have half-pixel shifts and kernels of a fixed size."""

COLLECT = '''
from typing import ClassVar
from tactflow.engine.frame import Tick
from tactflow.engine.contract import Sink
from tactflow.ports import ContactMask, Image
from tactflow.vision.types import Contact, Flow, Markers

class Collect(Sink):
    """Keeps what each frame gave."""
    rows: ClassVar[list] = []
    def __init__(self, params): Collect.rows.clear()
    def write(
        self, tick: Tick, image: Image | None, contact: Contact | None, flow: Flow | None,
        markers: Markers | None, contact_mask: ContactMask | None
    ) -> None:
        Collect.rows.append((tick, image, contact, flow, markers, contact_mask))
'''


@dataclass(frozen=True)
class Ran:
    """How a run ended, and what it gave: (tick, image, contact, flow, markers, contact mask) a frame."""

    result: RunResult
    rows: list[tuple[Any, ...]]

    @property
    def last(self) -> tuple[Any, ...]:
        return self.rows[-1]


def ran(name: str, frames: Sequence[Image] | Path, folder: Path, *settings: str) -> Ran:
    """Run a packaged pipeline on these frames, or on a folder of them."""
    (folder / "collect.py").write_text(COLLECT)
    source = frames if isinstance(frames, Path) else folder / "frames.npy"
    if not isinstance(frames, Path):
        np.save(source, np.stack(frames))
    packaged = (REPOSITORY / "pipelines" / f"{name}.yaml").read_text()
    file = folder / f"{name}.yaml"
    file.write_text(packaged)
    sinks = [f"sinks.{sink}=null" for sink in ("zmq", "jsonl") if f"  {sink}:" in packaged]
    pipeline = load_pipeline(
        file,
        [*sinks, "sinks.collect.use=./collect.py:Collect", *settings],
        source_values=[Override("source", str(source), "--source")],
    )
    runner = Runner(pipeline, check=True)
    result = runner.run()
    instance = next((node.instance for id_, node in runner.nodes.items() if id_ == "collect"), None)
    return Ran(result, list(type(instance).rows) if instance is not None else [])


def enlarged(picture: Image) -> Image:
    """A raw frame of which `downsample: 2` gives the picture."""
    return picture.repeat(2, axis=0).repeat(2, axis=1)


def sequence(name: str, change: Transformation = ROTATIONS[0]) -> list[Image]:
    """Untouched, touched, touched: raw frames."""
    pictures = gel(dots=name != "markerless")
    return [
        enlarged(change.picture(picture))
        for picture in (pictures.reference, pictures.touched, pictures.touched)
    ]


PLAIN = ("stages.preprocess.rotate=0", "stages.preprocess.downsample=2")


@pytest.mark.parametrize("change", [*ROTATIONS[1:], *MIRRORS], ids=lambda change: change.name)
@pytest.mark.parametrize("name", FOLLOWING)
def test_a_whole_pipeline_follows_turns_and_mirrors(
    name: str, change: Transformation, tmp_path: Path
) -> None:
    here = ran(name, sequence(name), tmp_path, *PLAIN)
    there = ran(name, sequence(name, change), tmp_path, *PLAIN)
    assert here.result.error is None, here.result.error
    assert there.result.error is None, there.result.error
    _, image, contact, flow, markers, mask = here.last
    _, image2, contact2, flow2, markers2, mask2 = there.last
    assert np.array_equal(change.picture(image), image2)
    # Filled markers are enlarged in fixed point, along x before y, so that turning them changes single pixels
    # by one grey level, and the outline by a pixel here and there: measured 1 px, 0.007 px, 0.02 degrees.
    assert apart(change.picture(mask), mask2) <= 1
    center = change.points(np.array([contact.center]), *SIZE)[0]
    np.testing.assert_allclose(contact2.center, center, rtol=0, atol=0.015)
    assert axis_difference(contact2.angle, change.angle(contact.angle)) < 0.04
    if name == "markerless":
        assert np.array_equal(change.picture(mask), mask2)
        assert contact2.area == contact.area
    if name == "markerless":
        assert markers is None
        return
    # Float32 sums in another order, as for the tracker alone.
    expected = change.points(markers.position, *SIZE)
    assert matched(markers2.position, expected).max() < 1e-3
    ends = change.points(np.array([[0.0, 0.0], flow.mean]), *SIZE)
    assert flow2.count == flow.count > 0
    np.testing.assert_allclose(flow2.mean, ends[1] - ends[0], rtol=0, atol=2e-3)


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
@pytest.mark.parametrize("name", FOLLOWING)
def test_rotating_in_preprocess_equals_rotating_the_sensor(name: str, turn: int, tmp_path: Path) -> None:
    by_stage = ran(name, sequence(name), tmp_path, f"stages.preprocess.rotate={turn}", PLAIN[1])
    by_hand = ran(name, sequence(name, ROTATIONS[(-turn // 90) % 4]), tmp_path, *PLAIN)
    for a, b in zip(by_stage.rows, by_hand.rows, strict=True):
        assert np.array_equal(a[1], b[1])
        assert np.array_equal(a[5], b[5])
        if a[4] is not None:
            assert np.array_equal(a[4].position, b[4].position)


@pytest.mark.parametrize("name", FOLLOWING)
def test_a_whole_pipeline_follows_a_doubling(name: str, tmp_path: Path) -> None:
    here = ran(name, sequence(name), tmp_path, *PLAIN)
    pictures = [DOUBLED.picture(frame[::2, ::2]) for frame in sequence(name)]
    there = ran(name, pictures, tmp_path, PLAIN[0], "stages.preprocess.downsample=1")
    contact, contact2 = here.last[2], there.last[2]
    # Both see the same border through cells of 4 x 4 px, and look for the largest change nearby in squares of
    # whole pixels; measured 0.32 px, 0.34 degrees.
    np.testing.assert_allclose(contact2.center, 2 * np.array(contact.center) + 0.5, rtol=0, atol=0.64)
    assert axis_difference(contact2.angle, contact.angle) < 0.68
    if name == "default":
        expected = DOUBLED.points(here.last[4].position, *SIZE)
        # As for the tracker alone.
        assert matched(there.last[4].position, expected).max() < 0.13


@pytest.mark.parametrize("name", PIPELINES)
def test_the_order_of_channels_and_an_offset_change_no_contact(name: str, tmp_path: Path) -> None:
    frames = sequence(name)
    here = ran(name, frames, tmp_path, *PLAIN)
    assert here.result.error is None, here.result.error
    for change in (lambda frame: frame[..., ::-1], lambda frame: frame + np.uint8(20)):
        there = ran(name, [change(frame) for frame in frames], tmp_path, *PLAIN)
        both = [run.last[5] > 0 for run in (here, there)]
        assert both[0].any()
        # Float32 sums in another order may move a border by a pixel.
        assert np.count_nonzero(both[0] != both[1]) <= 0.02 * np.count_nonzero(both[0])


# -- degenerate -------------------------------------------------------------------------------------------

STILL = {
    "black": np.zeros((60, 80, 3), np.uint8),
    "white": np.full((60, 80, 3), 255, np.uint8),
    "constant": np.full((60, 80, 3), 99, np.uint8),
    "checkerboard": enlarged(
        np.repeat((np.indices((30, 40)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None], 3, 2)
    ),
}


@pytest.mark.parametrize("kind", STILL)
@pytest.mark.parametrize("name", PIPELINES)
def test_a_still_degenerate_scene_is_no_contact_or_a_clear_refusal(
    name: str, kind: str, tmp_path: Path
) -> None:
    run = ran(name, [STILL[kind]] * 12, tmp_path)
    if run.result.error is not None:
        assert "markers found" in run.result.error
        assert "markerless.yaml" in run.result.error
        assert name != "markerless"
        return
    assert len(run.rows) == 12
    for tick, *values in run.rows:
        assert_defined([value for value in values if value is not None])
        assert values[1] is None, "nothing touches a scene that never changes"
        assert tick.frame.seq >= 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (3, 5), (37, 51)], ids=str)
@pytest.mark.parametrize("name", PIPELINES)
def test_tiny_and_odd_frames_end_in_an_answer_or_in_words(
    name: str, shape: tuple[int, int], tmp_path: Path
) -> None:
    frames = list(np.random.default_rng(0).integers(0, 256, (4, *shape, 3), dtype=np.uint8))
    run = ran(name, frames, tmp_path)
    if run.result.error is None:
        for row in run.rows:
            assert_defined([value for value in row[1:] if value is not None])
    else:
        assert "required" in run.result.error or "markers found" in run.result.error, run.result.error


@pytest.mark.parametrize("name", PIPELINES)
def test_a_reference_already_in_contact_runs_to_the_end(name: str, tmp_path: Path) -> None:
    frames = sequence(name)
    run = ran(name, [frames[1], frames[0], frames[1]], tmp_path, *PLAIN)
    assert run.result.error is None, run.result.error
    assert run.rows[0][2] is None
    assert run.rows[2][2] is None, "the reference again is no contact"
    for row in run.rows:
        assert_defined([value for value in row[1:] if value is not None])


@pytest.mark.parametrize("name", PIPELINES)
def test_frames_of_another_size_are_refused_with_both_sizes(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    folder.mkdir()
    frames = sequence(name)
    for index, picture in enumerate([frames[0], frames[1], frames[0][:200]]):
        cv2.imwrite(str(folder / f"{index}.png"), picture)
    run = ran(name, folder, tmp_path, *PLAIN)
    assert run.result.exit_code != 0
    assert run.result.error is not None
    assert "256" in run.result.error
    assert "200" in run.result.error


@pytest.mark.parametrize("name", PIPELINES)
def test_every_frame_becomes_a_message_without_nan(name: str, tmp_path: Path) -> None:
    run = ran(name, sequence(name), tmp_path, *PLAIN)
    assert run.result.error is None, run.result.error
    for row in run.rows:
        assert_defined([value for value in row[1:] if value is not None])
    assert run.last[2] is not None


@pytest.mark.parametrize("name", FOLLOWING)
def test_the_same_frame_for_ever_is_never_contact_and_never_moves(name: str, tmp_path: Path) -> None:
    frame = sequence(name)[0]
    run = ran(name, [frame] * 90, tmp_path, *PLAIN)
    assert run.result.error is None, run.result.error
    assert len(run.rows) == 90
    assert all(row[2] is None for row in run.rows)
    if name == "default":
        first: Points = run.rows[0][4].position
        assert all(np.array_equal(row[4].position, first) for row in run.rows)
