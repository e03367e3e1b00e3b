"""The probe stage: reference frames and the safety net."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.engine.frame import Frame
from tactflow.engine.run import Runner
from tactflow.stages.probe import Probe

IMAGE = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)


def changes(probe: Probe, count: int, *, reference: bool = False) -> list[bool]:
    return [probe.process(Frame("s", i, i / 60, IMAGE, reference=reference)).changed for i in range(count)]


def test_a_still_scene_is_worked_on_at_least_every_so_many_frames() -> None:
    probe = Probe(Probe.Params(at_least_every=5, hold=0))
    found = changes(probe, 40)
    assert found[:6] == [True] * 6, "while the noise is not known"
    assert [i for i, c in enumerate(found) if c][6:] == [10, 15, 20, 25, 30, 35]


def test_a_change_keeps_the_stages_at_work_for_a_while() -> None:
    probe = Probe(Probe.Params(hold=3))
    assert changes(probe, 20) == [True] * 9 + [False] * 11, "six frames to learn the noise, and three more"
    brighter = Frame("s", 20, 20 / 60, np.clip(IMAGE.astype(np.int16) + 9, 0, 255).astype(np.uint8))
    assert [probe.process(brighter).changed for _ in range(6)] == [True] * 4 + [False] * 2


def test_a_slow_motion_is_held_for_longer_each_time() -> None:
    """Light that grows too slowly for four held frames is seen over eight."""
    random = np.random.default_rng(1)
    probe = Probe(Probe.Params(hold=4))
    found = []
    for i in range(260):
        # 40 lines x 320 px x 3 channels: 2 sqrt(2 / 38400) = 0.0144 levels are one deviation of a difference
        # of two frames, so 0.013 levels a frame are 3.6 of them after four frames and 7.2 after eight.
        level = 0.013 * max(0, min(i, 160) - 60)
        rough = 120 + level + random.normal(0, 2, (240, 320, 3))
        image = np.clip(np.rint(rough), 0, 255).astype(np.uint8)
        found.append(probe.process(Frame("s", i, i / 60, image)).changed)
    assert np.mean(found[10:60]) < 0.3, "still"
    assert np.mean(found[110:160]) > 0.8, "moving"
    assert np.mean(found[210:260]) < 0.3, "still again"


@pytest.mark.parametrize("skipping", [True, False])
def test_the_probe_of_a_pipeline_knows_whether_it_skips(skipping: bool) -> None:
    root = Path(__file__).resolve().parents[2]
    without = ["sinks.zmq=null", "sinks.view=null", "sinks.jsonl.path=/dev/null"]
    pipeline = load_pipeline(root / "pipeline.yaml", [f"skipping={str(skipping).lower()}", *without])
    runner = Runner(pipeline, max_frames=3)
    assert runner.run().exit_code == 0
    assert (runner.nodes["probe"].instance._probe is not None) == skipping


def test_a_reference_frame_is_always_worked_on() -> None:
    probe = Probe(Probe.Params())
    assert all(changes(probe, 20, reference=True))


def test_a_reset_starts_anew() -> None:
    probe = Probe(Probe.Params(hold=0))
    assert not changes(probe, 10)[-1]
    probe.reset()
    assert changes(probe, 6) == [True] * 6
