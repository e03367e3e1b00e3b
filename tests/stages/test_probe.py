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


def test_frames_that_are_held_are_compared_with_the_one_that_changed() -> None:
    """Light that grows by 0.06 levels a frame is seen over eight frames, not over one."""
    random = np.random.default_rng(1)

    def frame(i: int, level: float) -> Frame:
        noise = random.normal(0, 2, (240, 320, 3))
        return Frame("s", i, i / 60, np.clip(np.rint(120 + level + noise), 0, 255).astype(np.uint8))

    def share(hold: int) -> float:
        probe = Probe(Probe.Params(hold=hold))
        for i in range(60):
            probe.process(frame(i, 0))
        return float(np.mean([probe.process(frame(60 + i, 0.06 * i)).changed for i in range(100)][10:]))

    # The window of all tiles: 40 x 320 px in each of three channels, so 2 sqrt(2 / 12800) = 0.025 levels are
    # one standard deviation of a difference, and the bound of 4.9 is 0.12: two frames' growth.
    assert share(hold=8) == 1.0
    assert share(hold=0) < 0.7


def test_only_the_last_held_frames_are_looked_at() -> None:
    """The others are worked on anyway: of a contact that moves, the first of three held frames is."""
    probe = Probe(Probe.Params(hold=5))
    changes(probe, 20)
    assert probe._probe is not None
    looked = []
    for i in range(31):
        before = probe._probe._looks
        image = np.roll(IMAGE, i + 1, axis=1)
        assert probe.process(Frame("s", 20 + i, (20 + i) / 60, image)).changed
        looked.append(probe._probe._looks > before)
    assert looked == [True] + 10 * [False, False, True]


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


def test_where_nothing_is_skipped_nothing_is_looked_at() -> None:
    probe = Probe(Probe.Params(), skipping=False)
    assert all(changes(probe, 40))
    assert probe._probe is None


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
