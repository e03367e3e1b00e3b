"""docs/policy.md: each command runs, and ends in a data set or a trained policy."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from plugins.lerobot.tests.lerobot_env import PYTHON, needs_datasets
from tests.clock import PATIENCE
from tests.paths import REPOSITORY

for package, extra in {"mcap": "record", "pyarrow": "lerobot", "av": "lerobot", "zarr": "zarr"}.items():
    pytest.importorskip(package, reason=f"the extra {extra} is not installed")

BLOCKS = re.findall(r"```(\w+)\n(.*?)```", (REPOSITORY / "docs" / "policy.md").read_text(), re.DOTALL)


def run_commands(folder: Path, program: str, python: Path, **environment: str) -> str:
    """Write the page's files into a folder, and run there all its commands of some programs, as a shell does.

    program : regular expression of their names. python : whose programs they are. Returns what they print.
    """
    for _, text in BLOCKS:
        if text.startswith("# "):
            (folder / text.split()[1]).write_text(text)
    lines = "\n".join(text for kind, text in BLOCKS if kind == "sh").replace("\\\n", " ")
    # A command goes on over lines where a quotation is open.
    commands = re.findall(rf"^{program}\b(?:'[^']*'|\"[^\"]*\"|[^'\"\n])*$", lines, re.MULTILINE)
    path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-ec", "\n".join(commands)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=6 * PATIENCE,
        env=os.environ | {"PATH": path} | environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_the_commands_that_need_no_robot_give_both_data_sets(tmp_path: Path) -> None:
    printed = run_commands(tmp_path, "tactflow", Path(sys.executable))
    assert printed.count("good: 60 frames") == 2
    assert len(list((tmp_path / "recordings").glob("*.mcap"))) == 4
    assert (tmp_path / "results" / "index.html").exists()
    info = json.loads((tmp_path / "datasets" / "both" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["fps"]) == (2, 30)
    assert {"observation.images.left", "observation.images.right"} <= info["features"].keys()
    buffer = tmp_path / "datasets" / "left-buffer" / "replay_buffer.zarr"
    assert json.loads((buffer / "meta" / "episode_ends" / ".zarray").read_text())["shape"] == [2]


@needs_datasets
def test_the_commands_with_lerobot_record_two_fingers_and_train_a_policy(tmp_path: Path) -> None:
    plugin = "lerobot_robot_sim_gripper"
    program = (REPOSITORY / "examples" / "lerobot" / f"{plugin}.py").read_text()
    (tmp_path / f"{plugin}.py").write_text(program)
    # LeRobot imports what is installed under such a name.
    (tmp_path / f"{plugin}-0.1.0.dist-info").mkdir()
    (tmp_path / f"{plugin}-0.1.0.dist-info" / "METADATA").write_text(f"Name: {plugin}\nVersion: 0.1.0\n")
    # LeRobot's viewer (760 MB), which the commands import and do not use.
    (tmp_path / "rerun.py").touch()
    private = {"HF_HUB_OFFLINE": "1", "HF_LEROBOT_HOME": str(tmp_path / "home"), "PYTHONPATH": str(tmp_path)}
    printed = run_commands(tmp_path, "(?:lerobot-record|python)", PYTHON, **private)
    assert re.findall(r"^epoch \d: loss \d", printed, re.MULTILINE)
    info = json.loads((tmp_path / "datasets" / "press" / "meta" / "info.json").read_text())
    assert info["total_episodes"] == 2
    pictures = {name for name in info["features"] if name.startswith("observation.images.")}
    assert pictures == {"observation.images.left", "observation.images.right"}
