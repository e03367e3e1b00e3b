"""The completion script, in the shell that it is written for."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tactflow.cli.main import main
from tests.clock import PATIENCE

pytestmark = pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")


@pytest.fixture
def script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert main(["completion", "bash"]) == 0
    file = tmp_path / "script"
    file.write_text(capsys.readouterr().out)
    return file


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["che"], {"check"}),
        (["det"], {"detect"}),
        (["detect", "no"], {"notes.txt"}),
        (["run", ""], {"left.yaml", "notes.txt", "folder"}),
        (["run", "le"], {"left.yaml"}),
        (["run", "left.yaml", "--max"], {"--max-frames"}),
        (["check", "left.yaml", "--se"], {"--set"}),
        (["run", "--jsonl", "no"], {"notes.txt"}),
        (["schema", "pi"], {"pipeline"}),
    ],
)
def test_bash_completes_commands_options_and_pipeline_files(
    words: list[str], expected: set[str], script: Path, tmp_path: Path
) -> None:
    here = tmp_path / "here"
    (here / "folder").mkdir(parents=True)
    for name in ("left.yaml", "notes.txt"):
        (here / name).touch()
    program = """
        source "$1"; shift
        COMP_WORDS=(tactflow "$@") COMP_CWORD=$#
        _shtab_tactflow 2> /dev/null
        printf '%s\\n' "${COMPREPLY[@]}"
    """
    done = subprocess.run(
        ["bash", "-c", program, "bash", str(script), *words],
        cwd=here,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    assert set(done.stdout.split()) == expected


@pytest.mark.parametrize("shell", ["zsh", "tcsh"])
def test_there_is_a_script_for_other_shells(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    assert "pipelines" in capsys.readouterr().out


def test_a_shell_that_is_not_known_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "ksh"]) == 2
    assert "bash" in capsys.readouterr().err
