"""Missing packages, and OpenCV packages that overwrite each other, are named with what to install."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from tactflow.cli.main import main
from tactflow.system.extras import OPENCV, opencv_conflict


def install(monkeypatch: pytest.MonkeyPatch, **versions: str) -> None:
    """Let these packages, written with underscores, be the only ones that are installed."""

    def version(name: str) -> str:
        try:
            return versions[name.replace("-", "_")]
        except KeyError:
            raise metadata.PackageNotFoundError(name) from None

    monkeypatch.setattr(metadata, "version", version)


@pytest.mark.parametrize("versions", [{}, {"opencv_python": "4.10"}])
def test_one_opencv_package_or_none_is_not_a_conflict(
    versions: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, **versions)
    assert opencv_conflict() is None


@pytest.mark.parametrize("command", [["check"], ["run", "--quiet", "--source", "sim:idle?frames=1"]], ids=str)
def test_two_are_named_once_with_the_command_that_repairs_it(
    command: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(monkeypatch, opencv_python="4.10.0", **{OPENCV.replace("-", "_"): "5.0.0"})
    assert main([*command, "--set", "sinks={}"]) == 0
    said = capsys.readouterr().err
    assert said.count(f"opencv-python 4.10.0 and {OPENCV} 5.0.0 are installed together") == 1
    assert f"pip uninstall --yes opencv-python {OPENCV}, then pip install {OPENCV}" in said


def test_a_recording_without_the_packages_for_it_is_refused_with_the_command_that_installs_them(
    tmp_path: Path,
) -> None:
    (tmp_path / "press.mcap").touch()
    program = (
        "import sys; sys.modules['zstandard'] = sys.modules['mcap'] = None; "
        "from tactflow.cli.main import main; sys.exit(main(['run', 'mini', '--source', 'press.mcap']))"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 4
    assert "pip install 'tactflow[record]'" in ended.stderr
    assert "Traceback" not in ended.stderr
