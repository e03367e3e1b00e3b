"""A source that is faster than the machine: the newest frame wins, and what was dropped can be counted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tactflow.cli.main import main
from tactflow.sim import open_scene
from tactflow.sim.export import write_frames

FRAMES = 120


def test_the_shipped_pipeline_drops_what_it_cannot_handle_and_shows_the_gaps(tmp_path: Path) -> None:
    """A moving contact at 10 000 frames a second: no machine handles that, so frames must be dropped."""
    moving = np.stack([open_scene("slide?frames=60").frame(index) for index in range(10, 22)])
    recording = tmp_path / "moving.npy"
    np.save(recording, np.resize(moving, (FRAMES, *moving.shape[1:])))
    code = main(
        [
            *("run", "--source", str(recording), "--realtime", "--quiet"),
            *("--set", "stages.capture.fps=10000", "--set", "sinks.zmq=null", "--set", "sinks.view=null"),
            *("--set", f"sinks.jsonl.path={tmp_path / 'out.jsonl'}", "--stats", str(tmp_path / "run.json")),
        ]
    )
    assert code == 0
    stats = json.loads((tmp_path / "run.json").read_text())
    seqs = [json.loads(line)["seq"] for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    link = stats["links"]["capture->compute"]
    assert link["policy"] == "latest"
    assert link["high_water"] == 1, "no frame waits behind another: the lag cannot grow"
    assert link["offered"] == link["delivered"] + link["drops"] == FRAMES
    assert (stats["frames"], stats["dropped"]) == (link["delivered"], link["drops"])
    assert stats["dropped"] > 0
    assert seqs[0] == 0, "the reference frame is never dropped"
    assert seqs == sorted(set(seqs))
    assert len(seqs) == stats["frames"]
    gaps = np.diff([*seqs, FRAMES]) - 1
    assert gaps.sum() == stats["dropped"]


def test_without_realtime_the_same_recording_loses_nothing(tmp_path: Path) -> None:
    write_frames(open_scene("tap?frames=60"), tmp_path / "tap.npy")
    code = main(
        [
            *("run", "--source", str(tmp_path / "tap.npy"), "--quiet", "--stats", str(tmp_path / "run.json")),
            *("--set", "stages.capture.fps=10000", "--set", "sinks.zmq=null", "--set", "sinks.view=null"),
            *("--set", f"sinks.jsonl.path={tmp_path / 'out.jsonl'}"),
        ]
    )
    assert code == 0
    stats = json.loads((tmp_path / "run.json").read_text())
    seqs = [json.loads(line)["seq"] for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert seqs == list(range(60))
    assert stats["dropped"] == 0
    assert stats["links"]["capture->compute"]["policy"] == "block"
