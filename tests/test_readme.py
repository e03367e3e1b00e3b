"""What the README shows works as shown."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import orjson
import pytest
import yaml
import zmq

from tactflow.cli.main import main, make_parser
from tests.clock import PATIENCE

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text()
STAGES = (REPOSITORY / "docs" / "pipeline-file.md").read_text()


def block(first_line: str) -> str:
    """The README's code block that starts with this line."""
    (found,) = [text for text in re.findall(r"```\w+\n(.*?)```", README, re.S) if text.startswith(first_line)]
    return found


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=cwd, capture_output=True, text=True, timeout=PATIENCE, check=False
    )


@pytest.mark.parametrize("by", ["file", "option"])
def test_a_stage_in_a_loose_file_replaces_a_built_in_one(
    by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bright.py").write_text(block("# bright.py"))
    pipeline = yaml.safe_load((REPOSITORY / "pipeline.yaml").read_text())
    change = yaml.safe_load(block("  difference: {use:"))
    options = ["--source", "sim:press?frames=60&light=bright", "--quiet", "--jsonl", "out.jsonl"]
    if by == "file":
        pipeline["stages"].update(change)
        pipeline["sinks"] = {}
        (tmp_path / "pipeline.yaml").write_text(yaml.safe_dump(pipeline, sort_keys=False))
    else:
        options += ["--set", "sinks={}", "--set", 'stages.difference={use: "./bright.py:Bright"}']
    monkeypatch.chdir(tmp_path)
    assert main(["run", *options]) == 0
    rows = [orjson.loads(line) for line in Path("out.jsonl").read_text().splitlines()]
    assert len(rows) == 60
    assert any(row["contact"] for row in rows)


def test_the_notebook_example_finds_the_dots(tmp_path: Path) -> None:
    (tmp_path / "notebook.py").write_text(block("# notebook.py"))
    done = run("notebook.py", cwd=tmp_path)
    assert done.stdout.startswith("80 dots of radius"), done.stderr


def test_every_command_and_stage_that_the_pages_name_is_there(capsys: pytest.CaptureFixture[str]) -> None:
    for command in set(re.findall(r"`tactflow (\w+)", README)):
        assert main([command, "--help"]) == 0, command
    table = STAGES.split("## The stages")[1].split("Sinks:")[0]
    stages = set(re.findall(r"^\| `(\w+)` \|.*\|$", table, re.M))
    capsys.readouterr()
    assert main(["stages"]) == 0
    listed = capsys.readouterr().out
    assert {"capture", "hull", "hold"} <= stages
    for stage in stages:
        assert stage in listed


PAGES = sorted([*REPOSITORY.glob("[RC]*.md"), *(REPOSITORY / "docs").glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_line_of_the_pages_is_valid(page: Path) -> None:
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.S)
    text = "".join(blocks).replace("\\\n", " ")
    # A quotation goes on over the end of a line; an apostrophe in a comment opens none.
    text = re.sub(r"(?m)(?<==)'[^'#]*'", lambda quoted: quoted[0].replace("\n", " "), text)
    for line in re.split("\n|&&", text):
        words = shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", "3"), comments=True)
        if words[:1] == ["tactflow"]:
            end = next((number for number, word in enumerate(words) if word in ("&", ">", "|")), None)
            make_parser(words[1]).parse_args(words[1:end])


def test_the_subscriber_example_prints_results(tmp_path: Path) -> None:
    with zmq.Context() as context, context.socket(zmq.REP) as finder:
        port = str(finder.bind_to_random_port("tcp://127.0.0.1"))
    code = block("# subscriber.py").replace("5556", port)
    (tmp_path / "subscriber.py").write_text(code)
    with subprocess.Popen(
        [sys.executable, "-u", "subscriber.py"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as listener:
        try:
            done = run(
                *("-m", "tactflow", "run", "--set", "sinks.jsonl=null", "--source", "sim:press?frames=60"),
                *("--set", f"sinks.zmq.endpoint=tcp://127.0.0.1:{port}", "--quiet"),
                *("--set", f"sinks.zmq.wait_for_subscriber={PATIENCE}"),
                cwd=tmp_path,
            )
            assert done.returncode == 0, done.stderr
            assert listener.stdout is not None
            assert re.match(r"\d+ (None|\[)", listener.stdout.readline())
        finally:
            listener.terminate()
