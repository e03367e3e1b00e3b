"""Two OpenCV packages in one environment are named, with what to do."""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

from tactflow.cli import opencv
from tactflow.cli.main import main


def having(**installed: str) -> Callable[[str], str]:
    def version(name: str) -> str:
        try:
            return installed[name.replace("-", "_")]
        except KeyError:
            raise metadata.PackageNotFoundError(name) from None

    return version


@pytest.mark.parametrize(
    "installed", [{}, {"opencv_python": "4.10"}, {"opencv_contrib_python_headless": "5.0"}]
)
def test_one_opencv_package_or_none_is_nothing_to_speak_of(installed: dict[str, str]) -> None:
    assert opencv.opencv_conflict(having(**installed)) is None


def test_two_opencv_packages_are_named_with_their_versions_and_the_command_that_mends_it() -> None:
    said = opencv.opencv_conflict(having(opencv_python="4.10.0", opencv_contrib_python_headless="5.0.0"))
    assert said is not None
    assert said.startswith("opencv-python 4.10.0 and opencv-contrib-python-headless 5.0.0 are installed")
    assert "pip uninstall --yes opencv-python opencv-contrib-python-headless, then" in said


@pytest.mark.parametrize("command", [["check"], ["run", "--quiet", "--source", "sim:idle?frames=1"]], ids=str)
def test_check_and_run_say_so_once(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    installed = having(opencv_python="4.10.0", opencv_contrib_python_headless="5.0.0")
    monkeypatch.setattr(opencv.opencv_conflict, "__defaults__", (installed,))
    pipeline = tmp_path / "pipeline.yaml"
    pipeline.write_text("stages:\n  capture: {}\nsinks:\n  record: {use: jsonl, path: r.jsonl}\n")
    monkeypatch.chdir(tmp_path)
    assert main([command[0], str(pipeline), *command[1:]]) == 0
    assert capsys.readouterr().err.count("overwrite each other's files") == 1
