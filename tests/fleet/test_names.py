"""What each sensor's process calls a file that the command line names once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tactflow.engine.errors import ConfigError
from tactflow.fleet.names import with_name


@pytest.mark.parametrize("path", ["", ".", "..", "x/", "x/.", "{sensor}/", "there", "in-{sensor}"])
def test_a_folder_is_no_file_for_each_sensor(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "in-a").mkdir()
    with pytest.raises(ConfigError, match="required a file, not a folder"):
        with_name(path, "a")


SHARED = [("-", "-"), ("/dev/stdout", "/dev/stdout"), (os.devnull, os.devnull)]
NAMED = [("out.jsonl", "out-a.jsonl"), ("x/{sensor}/o.json", "x/a/o.json"), ("plain", "plain-a")]


@pytest.mark.parametrize(("path", "expected"), SHARED + NAMED)
def test_files_of_the_command_line_get_the_sensors_name(path: str, expected: str) -> None:
    assert with_name(path, "a") == expected
