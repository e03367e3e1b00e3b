"""A replay buffer of several episodes: each begins anew, with its own reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import tactflow
from plugins.arrays.tests.test_datasets import write_replay_buffer
from tactflow.sim import open_scene
from tactflow.stages.capture import Capture

SETTINGS: dict[str, Any] = {"sinks": {}, "stages.preprocess": {"downsample": 1, "rotate": 0}}
LENGTHS = (20, 16, 12)


def episodes() -> list[np.ndarray]:
    """Presses on gels of three cameras; the last episode begins in a press, and the gel is released in it."""
    presses = []
    for seed, length in enumerate(LENGTHS, start=1):
        scene = open_scene(f"press?frames=60&seed={seed}")
        order = [59 - index if length == LENGTHS[-1] else index for index in range(15, 15 + 2 * length, 2)]
        frames = [np.asarray(scene.frame(index)) for index in order]
        presses.append(np.stack([cv2.resize(frame, (160, 120)) // seed for frame in frames]))
    return presses


@pytest.fixture(scope="module")
def buffer(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("buffer") / "replay_buffer.zarr"
    write_replay_buffer(path, np.concatenate(episodes()), np.cumsum(LENGTHS))
    return f"{path}?dataset=data/camera0_rgb"


def results(spec: str) -> list[tactflow.Result]:
    return list(tactflow.stream("markerless", source=spec, settings=SETTINGS))


def outline(result: tactflow.Result) -> tuple[Any, ...] | None:
    contact = result.contact
    return None if contact is None else (contact.center, contact.area, contact.angle)


def test_each_episode_gives_the_results_that_it_gives_alone(buffer: str) -> None:
    together = results(buffer)
    assert [result.seq for result in together] == list(range(sum(LENGTHS)))
    alone = [results(f"{buffer}&episode={episode}") for episode in range(3)]
    assert [len(found) for found in alone] == list(LENGTHS)
    assert [outline(one) for one in together] == [outline(one) for found in alone for one in found]
    touched = [sum(one.contact is not None for one in found) for found in alone]
    assert all(0 < count < length for count, length in zip(touched, LENGTHS, strict=True)), touched


@pytest.mark.parametrize("settle", [0.0, 3.0])
def test_each_episode_has_a_reference_of_its_own_or_the_named_picture(
    settle: float, buffer: str, tmp_path: Path
) -> None:
    picture = np.broadcast_to(np.linspace(60, 120, 160).astype(np.uint8)[:, None], (120, 160, 3))
    cv2.imwrite(str(tmp_path / "gel.png"), picture)
    for reference in (2, str(tmp_path / "gel.png")):
        capture = Capture(Capture.Params(source=buffer, reference=reference, settle=settle))
        capture.open()
        frames = list(capture.frames())
        capture.close()
        starts = np.cumsum([0, *LENGTHS[:-1]])
        for epoch, start in enumerate(starts):
            found = [frame for frame in frames if frame.epoch == epoch]
            assert [frame.seq for frame in found if frame.seq >= 0] == [*range(start, start + LENGTHS[epoch])]
            references = [frame for frame in found if frame.reference]
            if reference == 2:
                assert len(references) == 2
                same = [any(np.array_equal(one.image, frame.image) for frame in found) for one in references]
                assert all(same)
            else:
                (only,) = references
                assert found[0] is only
                assert (only.seq, only.t) == (-1, found[1].t)
                assert np.array_equal(only.image, picture)
        assert [frame.seq for frame in frames if frame.seq >= 0] == [*range(sum(LENGTHS))]


def test_a_recording_of_several_episodes_plays_with_the_same_results(buffer: str, tmp_path: Path) -> None:
    pytest.importorskip("mcap", reason="the extra record is not installed")
    lines = []
    for source, name in ((buffer, "first"), (str(tmp_path / "first.mcap"), "again")):
        sinks = {
            "record": {"path": str(tmp_path / f"{name}.mcap"), "preview": 0},
            "jsonl": {"path": str(tmp_path / f"{name}.jsonl")},
        }
        assert tactflow.run("markerless", source=source, settings=SETTINGS | {"sinks": sinks}).exit_code == 0
        lines.append((tmp_path / f"{name}.jsonl").read_text().splitlines())
    assert lines[0] == lines[1]
    assert len(lines[0]) == sum(LENGTHS)
