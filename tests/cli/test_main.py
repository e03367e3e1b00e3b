"""The program finds its commands, keeps output and messages apart, and never shows a traceback."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tactflow import __version__
from tactflow.cli.main import COMMANDS, main
from tactflow.engine.errors import SourceError, StageError
from tests.clock import PATIENCE

ROOT = Path(__file__).resolve().parents[2]


def program(*args: str, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "tactflow", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False, **options)  # type: ignore[call-overload, no-any-return]


def test_help_lists_every_command_and_what_it_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    for name, summary in COMMANDS.items():
        assert f" {name} {summary}" in words


@pytest.mark.parametrize("name", COMMANDS)
def test_every_listed_command_is_there(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    words = " ".join(capsys.readouterr().out.split())
    assert f"usage: tactflow {name}" in words
    assert COMMANDS[name] in words


def test_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"tactflow {__version__}\n"


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "required: COMMAND"),
        (["chek"], "there is no command chek; did you mean check?"),
        (["juggle"], "there is no command juggle; there are run, check"),
        (["check", "--sett", "a=b"], "unrecognized arguments: --sett"),
        (["run", "--max-fames", "6"], "usage: tactflow run"),
        (["run", "--max-fames=6"], "unrecognized arguments: --max-fames=6; did you mean --max-frames?"),
        (["check", "a.yaml", "b.yaml"], "unrecognized arguments: b.yaml"),
        (["run", "x.yaml", "--source", "1.png", __file__, "3.png"], "quote the pattern: --source 'FOLDER"),
        (["run", "x.yaml", __file__], f"unrecognized arguments: {__file__}\n"),
        (["check", "--set"], "expected one argument"),
        (["schema", "sensor"], "invalid choice"),
        (["stages", "hul"], "there is no stage or sink 'hul'; did you mean hull?"),
        (["stages", "./nowhere.py:A"], "cannot read ./nowhere.py"),
        (["explain", "--stats", "nowhere.json"], "nowhere.json: cannot be read"),
    ],
)
def test_a_wrong_command_line_gives_a_message_and_exit_code_2(
    argv: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    ("error", "code"), [(StageError("no"), 3), (SourceError("no"), 4), (KeyboardInterrupt(), 130)]
)
def test_an_error_becomes_its_exit_code(
    error: BaseException, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: object) -> int:
        raise error

    monkeypatch.setattr("tactflow.cli.check.run", fail)
    assert main(["check"]) == code
    assert capsys.readouterr().err == ("tactflow: no\n" if code != 130 else "")


@pytest.mark.parametrize(
    ("imports", "without"),
    [
        ("from tactflow.cli.main import main; main(['--help'])", {"cv2", "numpy", "pydantic"}),
        ("import tactflow.cli.run", {"asyncio", "numba", "pyarrow", "ssl", "websockets"}),
    ],
)
def test_what_a_command_does_not_need_at_its_start_is_not_imported(imports: str, without: set[str]) -> None:
    code = f"import sys; {imports}; print({without} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    assert done.stdout.splitlines()[-1] == "set()"


def test_a_command_has_its_garbage_collected_but_not_looked_for_in_what_was_imported() -> None:
    frozen = gc.get_freeze_count()
    gc.disable()
    try:
        assert main(["pipelines"]) == 0
        assert gc.isenabled()
        assert gc.get_freeze_count() > frozen
    finally:
        gc.enable()
        gc.unfreeze()


def test_a_reader_that_leaves_early_causes_no_complaint() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as out:
        done = subprocess.run(
            [sys.executable, "-m", "tactflow", "schema", "pipeline"],
            stdout=out,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    assert (done.returncode, done.stderr) == (0, "")


def test_the_program_ends_with_the_exit_code() -> None:
    done = program("check", "nowhere.yaml")
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "tactflow: there is no file nowhere.yaml\n"


def test_without_a_name_the_pipeline_in_the_current_directory_is_taken_else_the_packaged_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["check"]) == 0
    assert "default.yaml: OK" in capsys.readouterr().out
    (tmp_path / "pipeline.yaml").write_text("stages:\n  capture:\nsinks:\n  jsonl:\n")
    assert main(["check"]) == 0
    assert capsys.readouterr().out == "pipeline.yaml: OK (1 stage, 1 sink, 2 segments)\n"


@pytest.mark.parametrize("name", ["classic", "classic.yaml", "pipelines/classic.yaml"])
def test_a_packaged_pipeline_is_found_by_its_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["check", name]) == 0
    assert "classic.yaml: OK" in capsys.readouterr().out


@pytest.mark.parametrize(
    "path", [*sorted(ROOT.glob("pipelines/*.yaml")), ROOT / "pipeline.yaml"], ids=lambda p: p.stem
)
def test_every_shipped_pipeline_is_right(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(path)]) == 0
    assert ": OK (" in capsys.readouterr().out


def test_a_program_without_standard_output_does_its_work() -> None:
    done = subprocess.run(
        ["sh", "-c", f"'{sys.executable}' -m tactflow.cli.main stages >&-"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(sys.platform == "win32", reason="sh closes it")
def test_a_program_without_standard_error_says_what_letters_its_output_has(tmp_path: Path) -> None:
    (tmp_path / "ü.yaml").write_text("stages: {capture: {source: sim:idle}}")
    done = subprocess.run(
        ["sh", "-c", f"'{sys.executable}' -m tactflow check ü.yaml 2>&-"],
        stdout=subprocess.PIPE,
        text=True,
        timeout=PATIENCE,
        check=False,
        cwd=tmp_path,
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
    )
    assert done.returncode == 0
    assert done.stdout.startswith("\\xfc.yaml: OK")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
@pytest.mark.parametrize("words", [("stages",), ("schema", "message"), ("sim", "--list"), ("explain",)])
def test_a_full_disk_behind_standard_output_is_an_error_and_no_traceback(words: tuple[str, ...]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "tactflow", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE,
            check=False,
            cwd=ROOT,
        )
    assert done.returncode == 3
    assert done.stderr.endswith("tactflow: standard output: No space left on device\n")
    assert "Traceback" not in done.stderr


def test_names_in_brackets_are_shown_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = "[bold][/y]"
    words = ["run", "--source", "sim:idle?frames=3", "--set", "sinks.zmq=null", "--set", "sinks.view=null"]
    assert main([*words, "--jsonl", f"{name}.jsonl"]) == 0
    said = capsys.readouterr().err
    assert f"jsonl_2: {name}.jsonl" in said.replace("jsonl: [", "jsonl_2: [")
    assert main([*words[:1], "--source", f"{name}.png", *words[3:]]) == 4
    *_, error, ending = capsys.readouterr().err.splitlines()
    assert f"capture (--source {name}.png): " in error
    assert ending.endswith("0 dropped (error)")


def test_the_summary_of_one_frame(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--source", "sim:idle?frames=1", "--set", "sinks={}"]) == 0
    assert "\n1 frame in " in "\n" + capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere every file name is text")
def test_a_name_that_is_no_text_is_pointed_at(tmp_path: Path) -> None:
    done = program("run", "--source", "\udcff.png", "--quiet", cwd=tmp_path)
    assert done.returncode == 2
    assert "--source: '\\udcff.png' is not UTF-8; rename the file" in done.stderr


@pytest.mark.parametrize("option", ["--stats", "--trace"])
def test_statistics_replace_only_older_statistics(
    tmp_path: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "numbers.json"
    command = ["run", "--quiet", "--set", "sinks={}", "--source", "sim:press?frames=2", option, str(file)]
    assert main(command) == main(command) == 0
    file.write_text("a year of work")
    assert main(command) == 2
    assert "holds something else" in capsys.readouterr().err
    assert file.read_text() == "a year of work"


@pytest.mark.parametrize(
    ("files", "writer"),
    [
        ({"--jsonl": "a.jsonl", "--stats": "./a.jsonl"}, "jsonl"),
        ({"--jsonl": "a.jsonl", "--trace": "a.jsonl"}, "jsonl"),
        ({"--stats": "a.json", "--trace": "a.json"}, "--stats"),
    ],
)
@pytest.mark.parametrize("sensors", ["", "sensors: {left: , right: }\n"], ids=["one", "two"])
def test_a_report_replaces_nothing_that_the_run_writes(
    tmp_path: Path,
    files: dict[str, str],
    writer: str,
    sensors: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "pipeline.yaml").write_text(sensors + "stages: {capture: {source: 'sim:press?frames=2'}}\n")
    monkeypatch.chdir(tmp_path)
    options = [word for option in files.items() for word in option]
    assert main(["run", "--quiet", *options]) == 2
    assert f"{writer} writes it already; choose another file" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["pipeline.yaml"]
