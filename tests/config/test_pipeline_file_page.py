"""The examples of docs/pipeline-file.md are right, and the page names every key."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tactflow.cli.main import main
from tactflow.config.models import PipelineFile, SinkEntry
from tactflow.engine.graph import OnError, Queue

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "pipeline-file.md").read_text()
WHOLE, *EXAMPLES = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = re.findall(r"^tactflow (check .*)$", PAGE, re.MULTILINE)


def laid_over(base: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """The base with the values of a part in it."""
    merged = dict(base)
    for key, value in part.items():
        old = merged.get(key)
        merged[key] = laid_over(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


@pytest.mark.parametrize("example", ["", *EXAMPLES], ids=range(len(EXAMPLES) + 1))
def test_every_example_is_right(example: str, tmp_path: Path) -> None:
    part = yaml.safe_load(example) or {}
    base = yaml.safe_load(WHOLE)
    if "sensors" in part:
        del base["sensor"]
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(laid_over(base, part), sort_keys=False))
    assert main(["check", str(tmp_path / "p.yaml")]) == 0


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_is_right(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(ROOT / "pipeline.yaml", tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command)) == 0


@pytest.mark.parametrize("model", [PipelineFile, SinkEntry, Queue, OnError])
def test_every_key_stands_on_the_page(model: type[Any]) -> None:
    for name, field in model.model_fields.items():
        key = field.alias or name
        assert re.search(rf"`{key}`|\b{key}: ", PAGE), key
