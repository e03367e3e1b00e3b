"""The program finds its commands, keeps output and messages apart, and never shows a traceback."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import cv2
import pytest

from tactflow.cli.main import all_commands
from tests.clock import PATIENCE
from tests.terminal import Terminal


def program(*args: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tactflow", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, **options)  # type: ignore[call-overload, no-any-return]


def in_shell(redirection: str, *args: str, **options: object) -> subprocess.CompletedProcess[str]:
    """Run the program with a redirection such as `>&-`."""
    command = ["sh", "-c", f'"$0" -m tactflow "$@" {redirection}', sys.executable, *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, **options)  # type: ignore[call-overload, no-any-return]


@pytest.mark.parametrize("name", all_commands())
def test_every_listed_command_is_there(name: str, terminal: Terminal) -> None:
    assert terminal("--help") == 0
    summary = all_commands()[name].summary
    assert f" {name} {summary}" in " ".join(terminal.out.split())
    assert terminal(name, "--help") == 0
    words = " ".join(terminal.out.split())
    assert f"usage: tactflow {name}" in words
    assert summary in words


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "required: COMMAND"),
        (["chek"], "there is no command chek; did you mean check?"),
        (["run", "--max-fames=6"], "unrecognized arguments: --max-fames=6; did you mean --max-frames?"),
        (["check", "a.yaml", "b.yaml"], "unrecognized arguments: b.yaml"),
        (["run", "x.yaml", "--source", "1.png", __file__, "3.png"], "quote the pattern: --source 'FOLDER"),
        (["listen", "--timeout", "0"], "required a number of seconds, such as 2.5, got '0'"),
        (["stages", "hul"], "there is no stage or sink 'hul'; did you mean hull?"),
        (["stages", "./nowhere.py:A"], "cannot read ./nowhere.py"),
        (["warmup", "nowhere.yaml"], "there is no file nowhere.yaml"),
        (["run", "sim:press"], "there is no file sim:press, and no pipeline"),
        (["run", "data/film.avi"], "a camera, a recording or a stream is given as --source data/film.avi"),
        (["run", "film.mp4"], "is not a pipeline file (YAML); a camera, a recording or a stream is given as"),
        (["run", "."], "is a folder; required: a pipeline file (YAML); a camera, a recording or a stream is"),
        (["run", "--max-frames", "none"], "required a whole number"),
        (["explain", "--stats", "nowhere.json"], "nowhere.json: cannot be read"),
    ],
)
def test_a_wrong_command_line_gives_a_message_and_exit_code_2(
    argv: list[str], words: str, terminal: Terminal
) -> None:
    Path("film.mp4").write_bytes(b"\0\0\0\x20ftyp")
    assert terminal(*argv) == 2
    assert terminal.out == ""
    assert words in terminal.err


@pytest.mark.parametrize(
    ("imports", "without"),
    [
        ("import tactflow", {"cv2", "zmq", "pydantic"}),
        ("import tactflow.network.subscriber", {"cv2"}),
        ("from tactflow.cli.main import main; main(['--help'])", {"cv2", "numpy", "pydantic"}),
        ("import tactflow.cli.run", {"asyncio", "pyarrow", "rich", "scipy", "ssl", "websockets"}),
    ],
)
def test_what_is_not_needed_at_the_start_is_not_imported(imports: str, without: set[str]) -> None:
    code = f"import sys; {imports}; print({without} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"


def test_without_a_name_the_pipeline_in_the_current_folder_is_taken_else_the_packaged_one(
    tmp_path: Path, terminal: Terminal
) -> None:
    assert terminal("check") == 0
    assert "default.yaml: OK" in terminal.out
    (tmp_path / "pipeline.yaml").write_text("stages:\n  capture:\nsinks:\n  jsonl:\n")
    assert terminal("check") == 0
    assert terminal.out == "pipeline.yaml: OK (1 stage, 1 sink, 2 segments)\n"
    for name in ("classic", "classic.yaml", "pipelines/classic.yaml"):
        assert terminal("check", name) == 0
        assert "classic.yaml: OK" in terminal.out


# -- what stands behind standard output and standard error ------------------------------------------------


@pytest.mark.skipif(sys.platform == "win32", reason="needs sh")
def test_a_program_without_standard_output_or_error_does_its_work(tmp_path: Path) -> None:
    done = in_shell(">&-", "stages")
    assert (done.returncode, done.stderr) == (0, "")
    (tmp_path / "ü.yaml").write_text("stages: {capture: {source: sim:idle}}")
    ascii_only = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = in_shell("2>&-", "check", "ü.yaml", cwd=tmp_path, env=ascii_only)
    assert done.returncode == 0
    assert done.stdout.startswith("\\xfc.yaml: OK")


@pytest.mark.parametrize(
    ("stream", "words", "code"),
    [("stdout", ("schema", "pipeline"), 0), ("stderr", ("run", "--source", "missing.mp4"), 4)],
)
def test_a_reader_that_leaves_early_changes_no_exit_code(
    stream: str, words: tuple[str, ...], code: int, tmp_path: Path
) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "tactflow", *words]
    with os.fdopen(writing, "wb") as unread:
        streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, stream: unread}
        done = subprocess.run(command, cwd=tmp_path, timeout=PATIENCE, check=False, **streams)  # type: ignore[call-overload]
    assert done.returncode == code
    assert not done.stderr


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
def test_a_full_disk_behind_standard_output_is_an_error_without_a_traceback() -> None:
    done = in_shell(">/dev/full", "schema", "message")
    assert done.returncode == 3
    assert done.stderr == "tactflow: standard output: No space left on device\n"


# -- reports of a run -------------------------------------------------------------------------------------


def test_statistics_replace_only_older_statistics(tmp_path: Path, terminal: Terminal) -> None:
    file = tmp_path / "numbers.json"
    command = ["run", "--quiet", "--set", "sinks={}", "--source", "sim:press?frames=2", "--stats", str(file)]
    assert terminal(*command) == terminal(*command) == 0
    file.write_text("a year of work")
    assert terminal(*command) == 2
    assert "is not a statistics file" in terminal.err
    assert file.read_text() == "a year of work"


def test_statistics_replace_no_results(terminal: Terminal) -> None:
    command = ["run", "--quiet", "--set", "sinks={}", "--source", "sim:press?frames=2"]
    assert terminal(*command, "--jsonl", "a.jsonl", "--stats", "./a.jsonl") == 3
    assert "a.jsonl" in terminal.err
    assert '"frames"' not in Path("a.jsonl").read_text()


def test_no_name_of_a_file_forges_a_line_of_the_messages(terminal: Terminal) -> None:
    for mark in ("\n", "\r", "\u2028", "\u2029", "\x85", "\u202e", "\x1b["):
        name = f"left{mark}tactflow: INFO: all frames delivered"
        for words, code in ((["run", "--source", name], 4), (["run", "a.yaml", name], 2), ([name], 2)):
            assert terminal(*words) == code
            lines = terminal.err.splitlines()
            assert not any(line.startswith("tactflow: INFO") for line in lines)
            assert not any(letter in "".join(lines) for letter in "\x1b\u202e")


def test_a_shipped_pipeline_is_printed_to_be_changed(terminal: Terminal) -> None:
    assert terminal("pipelines", "mini") == 0
    Path("pipeline.yaml").write_text(terminal.out)
    assert terminal("check") == 0
    assert terminal("pipelines") == 0
    assert "mini " in terminal.out
    assert terminal("pipelines", "minni") == 2
    assert "did you mean mini?" in terminal.err


def test_one_option_writes_a_video_with_the_results(terminal: Terminal) -> None:
    command = ["run", "default", "--source", "sim:press?frames=30", "--video", "out.mp4", "--quiet"]
    assert terminal(*command, "--set", "sinks={}") == 0
    film = cv2.VideoCapture("out.mp4")
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 30
    film.release()


def test_the_summary_counts_what_the_results_say(terminal: Terminal) -> None:
    # Stages before `hull` see contacts that are too small for it.
    command = ["run", "default", "--source", "sim:press?frames=60", "--set", "stages.hull.min_area=2000"]
    assert terminal(*command, "--set", "sinks={}", "--jsonl", "a.jsonl") == 0
    touched = [json.loads(line)["contact"] is not None for line in Path("a.jsonl").read_text().splitlines()]
    begun = sum(now and not before for before, now in pairwise([False, *touched]))
    assert begun > 0
    assert f"contacts: {begun} ({sum(touched)} frames with contact)" in terminal.err
