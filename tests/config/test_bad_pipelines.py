"""Every mistake in a pipeline file is reported with its place, with exit code 2 and without a traceback."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactflow.cli.main import main
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.plan import make_plan

ROOT = Path(__file__).resolve().parents[2]
PARTS = Path(__file__).with_name("parts.py")
HERE = "§"
"""Stands in a case's text where the mistake must be found; it is taken out before the file is written."""

HEAD = "stages:\n  capture: {use: './parts.py:Source'}\n"
PREPARE = HEAD + "  prepare: {use: './parts.py:Prepare'}\n"
COMPARE = PREPARE + "  compare: {use: './parts.py:Compare'}\n"
OUTLINE = COMPARE + "  outline: {use: './parts.py:Outline'}\n"
SINK = "sinks:\n  out: {use: './parts.py:Publish'}\n"

CASES: dict[str, tuple[str, list[str]]] = {
    # the file as such
    "empty file": ("§", ["the file is empty", "required"]),
    "only a comment": ("§# nothing here\n", ["the file is empty"]),
    "a list": ("§- capture\n- hull\n", ["expected a mapping", "got a list"]),
    "a word": ("§hello\n", ["expected a mapping", "got 'hello'"]),
    "tab indentation": ("stages:\n§\tcapture: {}\n", ["tab character", "blanks"]),
    "unclosed bracket": ("stages: {capture: {\n§", ["not valid YAML"]),
    "unclosed quote": ("sensor: 'main\nstages: {}\n§", ["not valid YAML", "starts in line 1"]),
    "colon in plain text": ("sensor: a§: b\n", ["not valid YAML", "quotes"]),
    "two documents": (SINK + "§---\n" + HEAD, ["second document"]),
    "undefined alias": ("sensor: §*name\n", ["undefined alias"]),
    "python object": (
        "sensor: §!!python/object/apply:os.getcwd []\n",
        ["!!python/object/apply:os.getcwd", "not allowed"],
    ),
    "value that contains itself": ("§stages: &all\n  capture: *all\n", ["nested too deeply"]),
    "control character": ('sensor: "a§\x01b"\n', ["#x0001", "not allowed"]),
    "duplicate top-level key": (
        "sensor: a\n§sensor: b\n" + HEAD + SINK,
        ["sensor: duplicate key", "line 1, column 1"],
    ),
    "duplicate parameter": (
        HEAD + "  prepare: {use: './parts.py:Prepare', gamma: 1, §gamma: 2}\n" + SINK,
        ["gamma: duplicate key"],
    ),
    "key that is no text": (HEAD + "  §yes: {}\n" + SINK, ["a key must be text", "quotes"]),
    "merge of a list": (
        HEAD + "  prepare:\n    <<: §[1]\n".replace("§[1]", "[§1]") + SINK,
        ["for merging, but found scalar"],
    ),
    # the envelope
    "misspelled top-level key": (
        "§stagse: {}\n" + HEAD + SINK,
        ["stagse: unknown key", "did you mean stages?"],
    ),
    "no stages": ("§sensor: main\n", ["stages: required, but not given", "id -> stage"]),
    "stages that are a list": (
        "stages:\n  §- capture\n" + SINK,
        ["stages: should be a mapping", "got a list"],
    ),
    "empty stages": ("§stages: {}\n" + SINK, ["no source of frames", "capture"]),
    "sinks that are text": (HEAD + "sinks: §zmq\n", ["sinks: should be a mapping", "got 'zmq'"]),
    "stage that is text": (
        HEAD + "  prepare: §fast\n" + SINK,
        ["stages.prepare: should be a mapping", "got 'fast'"],
    ),
    "bad id": (HEAD + "  §a.b: {}\n" + SINK, ["stages.a.b: should be a word"]),
    "one id for a stage and a sink": (
        HEAD + "sinks:\n  §capture: {use: './parts.py:Publish'}\n",
        ["the id capture is taken by stages.capture", "bad.yaml:2:3"],
    ),
    "bad sensor name": (
        "sensor: §left hand\n" + HEAD + SINK,
        ["sensor: should be a word", "got 'left hand'"],
    ),
    "bad flag": ("skipping: §1\n" + HEAD + SINK, ["skipping: should be a valid boolean, got 1"]),
    "bad thread count": (
        "opencv_threads: §-1\n" + HEAD + SINK,
        ["opencv_threads: should be greater than or equal to 0"],
    ),
    "bad queue": (
        HEAD + "  prepare: {use: './parts.py:Prepare', queue: §4}\n" + SINK,
        ["stages.prepare.queue: should be a mapping", "got 4"],
    ),
    "unknown policy": (
        HEAD + "  prepare: {use: './parts.py:Prepare', queue: {when_full: §lates}}\n" + SINK,
        ["when_full: should be 'block', 'latest' or 'drop_oldest'", "did you mean latest?"],
    ),
    "unknown error action": (
        HEAD + "  prepare: {use: './parts.py:Prepare', on_error: §ignore}\n" + SINK,
        ["on_error: should be 'stop', 'skip_frame' or 'disable', got 'ignore'"],
    ),
    "bad error budget": (
        HEAD
        + "  prepare: {use: './parts.py:Prepare', on_error: {action: skip_frame, budget: §many}}\n"
        + SINK,
        ["on_error.budget: should be a valid integer, got 'many'"],
    ),
    "rate of a stage": (
        HEAD + "  prepare: {use: './parts.py:Prepare', §max_rate: 5}\n" + SINK,
        ["stages.prepare.max_rate: unknown parameter"],
    ),
    # what `use` names
    "misspelled stage": (
        HEAD + "  h: {use: §captur}\n" + SINK,
        ["no stage called captur", "did you mean capture?"],
    ),
    "unknown stage": (
        HEAD + "  §teleport:\n" + SINK,
        ["stages.teleport: there is no stage called teleport", "./file.py:Class"],
    ),
    "sink among stages": (HEAD + "  §jsonl:\n" + SINK, ["jsonl is under stages: but belongs under sinks:"]),
    "stage among sinks": (
        HEAD + "sinks:\n  out: {use: §'./parts.py:Prepare'}\n",
        ["is a stage; it belongs under stages:"],
    ),
    "missing file": (
        HEAD + "  a: {use: §'./nowhere.py:A'}\n" + SINK,
        ["cannot read ./nowhere.py", "No such file"],
    ),
    "missing class": (
        HEAD + "  a: {use: §'./parts.py:Prepar'}\n" + SINK,
        ["no class Prepar", "did you mean Prepare?"],
    ),
    "something that is no stage": (
        HEAD + "  a: {use: §'collections:OrderedDict'}\n" + SINK,
        ["OrderedDict must inherit from Source or Stage or Sink of tactflow"],
    ),
    "stage and sink in one class": (
        HEAD + "  a: {use: §'./parts.py:Both'}\n" + SINK,
        ["Both: a sink has no process()", "a class is one of stage, sink and source"],
    ),
    "undeclared memory": (
        PREPARE + "  a: {use: §'./parts.py:Forgetful'}\n" + SINK,
        ["must declare memory", "stateful"],
    ),
    "port without a type": (
        PREPARE + "  a: {use: §'./parts.py:Bare'}\n" + SINK,
        ["Bare.process", "parameter image has no annotation"],
    ),
    # parameters
    "misspelled parameter": (
        COMPARE + "  outline:\n    use: ./parts.py:Outline\n    §min_aera: 5\n" + SINK,
        ["stages.outline.min_aera: unknown parameter; did you mean min_area?"],
    ),
    "missing parameter": (
        PREPARE + "  §a: {use: './parts.py:Needy'}\n" + SINK,
        ["stages.a.path: required, but not given"],
    ),
    "text for a number": (
        HEAD + "  p: {use: './parts.py:Prepare', gamma: §high}\n" + SINK,
        ["stages.p.gamma: should be a valid number, got 'high'"],
    ),
    "flag for a number": (
        HEAD + "  p: {use: './parts.py:Prepare', gamma: §yes}\n" + SINK,
        ["should be a valid number, got true"],
    ),
    "fraction for a whole number": (
        COMPARE + "  o: {use: './parts.py:Outline', min_area: §2.5}\n" + SINK,
        ["stages.o.min_area: should be a valid integer, got 2.5"],
    ),
    "too large": (
        HEAD + "  p: {use: './parts.py:Prepare', gamma: §5.5}\n" + SINK,
        ["should be less than or equal to 5, got 5.5"],
    ),
    "not a number": (
        HEAD + "  p: {use: './parts.py:Prepare', gamma: §.nan}\n" + SINK,
        ["should be a finite number"],
    ),
    "value that is missing": (
        HEAD + "  p:\n    use: ./parts.py:Prepare\n    gamma:§\n" + SINK,
        ["got nothing"],
    ),
    "number outside a choice": (
        HEAD + "  p: {use: './parts.py:Prepare', rotate: §45}\n" + SINK,
        ["stages.p.rotate: should be 0, 90, 180 or 270, got 45"],
    ),
    "misspelled choice": (
        HEAD + "  p: {use: './parts.py:Prepare', method: §pyramide}\n" + SINK,
        ["should be 'area' or 'pyramid', got 'pyramide'; did you mean pyramid?"],
    ),
    "scalar for a list": (
        HEAD + "  p: {use: './parts.py:Prepare', corners: §3}\n" + SINK,
        ["should be a list, got 3"],
    ),
    "wrong item deep in a list": (
        HEAD + "  p:\n    use: ./parts.py:Prepare\n    corners:\n      - [1, 2]\n      - [3, §x]\n" + SINK,
        ["stages.p.corners.1.1: should be a valid number, got 'x'"],
    ),
    "short pair in a list": (
        HEAD + "  p: {use: './parts.py:Prepare', corners: [[1, 2], §[3]]}\n" + SINK,
        ["stages.p.corners.1.1: this item of the list is missing"],
    ),
    "too many items": (
        HEAD
        + "  p: {use: './parts.py:Prepare', corners: §[[1, 2], [1, 2], [1, 2], [1, 2], [1, 2]]}\n"
        + SINK,
        ["stages.p.corners: should have at most 4 items, not 5"],
    ),
    "misspelled key of a nested mapping": (
        HEAD + "  p: {use: './parts.py:Prepare', lens: {focal: 3, §fishey: true}}\n" + SINK,
        ["stages.p.lens.fishey: unknown parameter; did you mean fisheye?"],
    ),
    "missing key of a nested mapping": (
        HEAD + "  p: {use: './parts.py:Prepare', §lens: {fisheye: true}}\n" + SINK,
        ["stages.p.lens.focal: required, but not given"],
    ),
    "none of several types": (
        "stages:\n  capture: {use: './parts.py:Source', source: §[0]}\n" + SINK,
        ["stages.capture.source: should be a valid string or a valid integer, got a list"],
    ),
    "wrong value in one of several mappings": (
        HEAD + "  p: {use: './parts.py:Prepare', shift: §{angle: steep}}\n" + SINK,
        ["stages.p.shift: by: required", "or angle: should be a valid number, got a mapping"],
    ),
    "long text": (
        COMPARE + "  o: {use: './parts.py:Outline', name: §abcdefghi}\n" + SINK,
        ["at most 8 characters"],
    ),
    "parameters that contradict each other": (
        HEAD + "  §p: {use: './parts.py:Prepare', size: [3, 4]}\n" + SINK,
        ["stages.p: size needs corners"],
    ),
    # the graph
    "two sources": (
        HEAD + "  §second: {use: './parts.py:Source'}\n" + SINK,
        ["one source", "capture (", "bad.yaml:2:3"],
    ),
    "no source": ("§stages:\n  prepare: {use: './parts.py:Prepare'}\n" + SINK, ["no source of frames"]),
    "dangling input": (
        PREPARE + "  §outline: {use: './parts.py:Outline'}\n" + SINK,
        ["needs contact_mask, but no stage above gives it", "frame (capture), image (prepare)", "difference"],
    ),
    "input from below": (
        PREPARE + "  §outline: {use: './parts.py:Outline'}\n  compare: {use: './parts.py:Compare'}\n" + SINK,
        ["compare gives it but stands below", "in: {contact_mask: compare.contact_mask}"],
    ),
    "sensors without a name": (
        COMPARE + SINK + "sensors: §{}\n",
        ["sensors: should have at least 1 item"],
    ),
    "dangling sink": (
        PREPARE + "sinks:\n  §out: {use: './parts.py:Require'}\n",
        ["needs contact, but no stage gives it"],
    ),
    "unknown input": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {§contactmask: compare.contact_mask}}\n" + SINK,
        ["o has no input contactmask; did you mean contact_mask?"],
    ),
    "inputs as a list": (
        COMPARE + "  o: {use: './parts.py:Outline', in: §[compare]}\n" + SINK,
        ["stages.o.in: should be a mapping, got a list"],
    ),
    "reference to no stage": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §compar.contact_mask}}\n" + SINK,
        ["there is no stage 'compar'; did you mean compare?"],
    ),
    "reference to no port": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §compare.mask}}\n" + SINK,
        ["compare (", "bad.yaml:4:3", "has no output 'mask'", "contact_mask"],
    ),
    "reference to a port without its stage": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §contact_mask}}\n" + SINK,
        ["'contact_mask' is a port, not a stage; write compare.contact_mask"],
    ),
    "reference to one of several outputs": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §compare}}\n" + SINK,
        ["compare has several outputs", "compare.contact_mask, compare.touching"],
    ),
    "reference to a sink": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §out.x}}\n" + SINK,
        ["out is a sink and gives nothing"],
    ),
    "required input taken away": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §null}}\n" + SINK,
        ["in.contact_mask: this input is required"],
    ),
    "arrays of different shape": (
        COMPARE + "  o: {use: './parts.py:Outline', in: {contact_mask: §prepare.image}}\n" + SINK,
        [
            "takes (H, W) uint8",
            "prepare.image",
            "bad.yaml:3:3",
            "gives (H, W, 3) uint8",
            "3 axes where 2 are wanted",
        ],
    ),
    "array for a dataclass": (
        COMPARE + "  o: {use: './parts.py:Refine', in: {contact: §prepare}}\n" + SINK,
        ["the input contact takes Contact, but prepare.image", "the types differ"],
    ),
    "cycle of two": (
        COMPARE
        + "  a: {use: './parts.py:Refine', in: {contact: §b}}\n  b: {use: './parts.py:Refine'}\n"
        + SINK,
        ["form a cycle, b -> a -> b", "a takes b.contact", "b takes a.contact", "bad.yaml:6:3"],
    ),
    "cycle through a gate": (
        PREPARE
        + "  invert: {use: './parts.py:Invert', when: §compare.touching}\n"
        + "  compare: {use: './parts.py:Compare'}\n"
        + SINK,
        ["form a cycle, compare -> invert -> compare"],
    ),
    # gates
    "misspelled gate": (
        COMPARE + "  o: {use: './parts.py:Outline', when: §toching}\n" + SINK,
        ["did you mean touching?"],
    ),
    "gate on something that is no signal": (
        COMPARE + "  o: {use: './parts.py:Outline', when: §image}\n" + SINK,
        ["a gate takes a signal", "prepare.image", "(H, W, 3)"],
    ),
    "gate from below": (
        PREPARE
        + "  i: {use: './parts.py:Invert', when: §touching}\n  compare: {use: './parts.py:Compare'}\n"
        + SINK,
        ["no stage above gives touching", "write compare.touching"],
    ),
    "gate on a source": (
        "stages:\n  capture: {use: './parts.py:Source', §when: touching}\n" + SINK,
        ["a source cannot be gated"],
    ),
    "gate without a signal": (
        COMPARE + "  o: {use: './parts.py:Outline', §when: {otherwise: repeat}}\n" + SINK,
        ["stages.o.when.signal: required, but not given", "bool port"],
    ),
    "gate that is a number": (
        COMPARE + "  o: {use: './parts.py:Outline', when: §5}\n" + SINK,
        ["when: should be a valid string", "got 5"],
    ),
    "unknown gate setting": (
        COMPARE + "  o: {use: './parts.py:Outline', when: {signal: touching, §otherwize: repeat}}\n" + SINK,
        ["when.otherwize: unknown key; did you mean otherwise?"],
    ),
    "unknown way of being closed": (
        COMPARE + "  o: {use: './parts.py:Outline', when: {signal: touching, otherwise: §zero}}\n" + SINK,
        ["when.otherwise: should be 'absent' or 'repeat', got 'zero'"],
    ),
    # what only the plan can see
    "segments in a circle": (
        HEAD
        + "  prepare: {use: './parts.py:Prepare'}\n"
        + "  compare: {use: './parts.py:Compare', segment: §a}\n"
        + "  outline: {use: './parts.py:Outline', segment: b}\n"
        + "  refine: {use: './parts.py:Refine', segment: a}\n"
        + SINK,
        ["compare: segments", "circle"],
    ),
    "a second queue in front of a segment": (
        HEAD
        + "  prepare: {use: './parts.py:Prepare', queue: {capacity: 2}}\n"
        + "  compare: {use: './parts.py:Compare', queue: §{capacity: 3}}\n"
        + "  outline: {use: './parts.py:Outline'}\n"
        + SINK,
        ["compare.queue: its segment has a queue already", "by prepare"],
    ),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current directory with the parts in it."""
    shutil.copy(PARTS, tmp_path / "parts.py")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", CASES)
def test_a_mistake_is_reported_at_its_place(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, words = CASES[name]
    before, _, after = text.partition(HERE)
    (folder / "bad.yaml").write_text(before + after)
    line = before.count("\n") + 1
    column = len(before) - before.rfind("\n")
    assert main(["check", "bad.yaml"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    found = next((part for part in err.splitlines() if f"bad.yaml:{line}:{column}  " in part), None)
    assert found is not None, err
    for word in words:
        assert word in found


@pytest.mark.parametrize("command", ["run", "check", "explain", "graph"])
def test_every_command_that_reads_a_pipeline_refuses_a_bad_one(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad.yaml").write_text(HEAD + "  prepare: {}\n" + SINK)
    assert main([command, "bad.yaml", "--set", "sinks.out.path=3"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "bad.yaml:3:3  stages.prepare: there is no stage called prepare" in err
    assert "--set sinks.out.path=3: sinks.out.path: should be a valid string, got 3" in err
    assert "Traceback" not in err


def test_all_mistakes_come_at_once_in_the_order_of_the_file(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad.yaml").write_text(
        "sensor: a b\n" + PREPARE + "  o: {use: './parts.py:Outline', min_aera: 3, when: tuching}\nsink: {}\n"
    )
    assert main(["check", "bad.yaml"]) == 2
    err = capsys.readouterr().err
    places = re.findall(r"^bad\.yaml:(\d+):\d+  ", err, re.MULTILINE)
    assert places == ["1", "5", "5", "5", "6"]
    assert err.startswith("tactflow: 5 mistakes\n")


def test_the_caret_stands_under_the_mistake(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "bad.yaml").write_text(HEAD + "  p: {use: './parts.py:Prepare', gamma: 9}\n" + SINK)
    main(["check", "bad.yaml"])
    _, shown, caret = capsys.readouterr().err.splitlines()
    assert caret.strip() == "^"
    assert shown[caret.index("^")] == "9"


def test_a_long_line_is_cut_around_the_mistake(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "bad.yaml").write_text(
        HEAD + f"  p: {{use: './parts.py:Prepare', gamma: {' ' * 300} x {' ' * 300} }}\n" + SINK
    )
    main(["check", "bad.yaml"])
    lines = capsys.readouterr().err.splitlines()
    row = next(index for index, line in enumerate(lines) if "got 'x'" in line)
    assert len(lines[row + 1]) < 200
    assert lines[row + 1][lines[row + 2].index("^")] == "x"


def test_bytes_that_are_not_utf8_have_a_place(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "bad.yaml").write_bytes(b"sensor: main\nskipping: \xff\n")
    assert main(["check", "bad.yaml"]) == 2
    assert "bad.yaml:2:11  byte 0xff is not UTF-8 text" in capsys.readouterr().err


def test_a_byte_order_mark_is_no_mistake(folder: Path) -> None:
    (folder / "good.yaml").write_bytes(b"\xef\xbb\xbf" + (HEAD + SINK).encode())
    assert main(["check", "good.yaml"]) == 0


def test_aliases_that_unfold_without_end_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = ["a0: &a0 [1, 2, 3, 4, 5, 6, 7, 8, 9]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    (folder / "bad.yaml").write_text("\n".join(lines))
    assert main(["check", "bad.yaml"]) == 2
    assert "more than 100000 values" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["long.yaml", "/dev/zero"])
def test_a_file_without_end_is_not_read_to_the_end(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if not Path("/dev/zero").exists():
        pytest.skip("there is no /dev/zero on this system")
    (folder / "long.yaml").write_text("stages:\n" + "- a\n" * 100_000)
    assert main(["check", name]) == 2
    assert f"{name} is larger than 256 KiB" in capsys.readouterr().err


def test_endless_nesting_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "bad.yaml").write_text("stages: " + "[" * 5000)
    assert main(["check", "bad.yaml"]) == 2
    assert "nested too deeply" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argument", "words"),
    [("nowhere.yaml", "there is no file nowhere.yaml"), (".", "is a folder"), ("parts.py/x", "cannot read")],
)
def test_a_file_that_cannot_be_read(
    argument: str, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert folder.is_dir()
    assert main(["check", argument]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("class A:\n    def process(self\n", r"own\.py:2: cannot load \./own\.py: '\(' was never closed"),
        ("import no_such_thing\n", r"own\.py:1: cannot load \./own\.py: ModuleNotFoundError"),
        ("x = 1\ny = x / 0\n", r"own\.py:2: cannot load \./own\.py: ZeroDivisionError"),
        ("raise SystemExit(5)\n", r"own\.py:1: cannot load \./own\.py: SystemExit"),
        (
            "class _A:\n    def process(self): ...\n",
            r"own\.py has no public class that inherits from Stage",
        ),
    ],
)
def test_a_mistake_in_an_own_file_is_shown_with_its_line(
    body: str, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "own.py").write_text(body)
    (folder / "bad.yaml").write_text(PREPARE + "  own: {use: ./own.py}\n" + SINK)
    assert main(["check", "bad.yaml"]) == 2
    err = capsys.readouterr().err
    assert "bad.yaml:4:14  stages.own.use: " in err
    assert re.search(words, err), err
    assert "Traceback" not in err


def mutations(text: str) -> Iterator[str]:
    """The text with each line left out, doubled, misspelled, shifted, retagged, with a tab, cut off."""
    rng = random.Random(20)
    lines = [line for line in text.splitlines() if line.split("#")[0].strip()]
    for i, line in enumerate(lines):
        head, tail = lines[:i], lines[i + 1 :]
        yield "\n".join(head + tail)
        yield "\n".join([*head, line, line, *tail])
        yield "\n".join([*head, "  " + line, *tail])
        yield "\n".join([*head, line[1:], *tail])
        yield "\n".join([*head, "\t" + line, *tail])
        if line.strip():
            at = rng.randrange(len(line))
            yield "\n".join([*head, line[:at] + "x" + line[at + 1 :], *tail])
            yield "\n".join([*head, line[:at] + rng.choice("{}[]:,&*!|>%@`'\"#?-") + line[at:], *tail])
            yield "\n".join([*head, line[:at]])
        if ":" in line:
            key, _, value = line.partition(":")
            for tag in (
                "!!python/name:os.system",
                "!!int",
                "!!binary",
                "[",
                "null #",
                "{a: 1} #",
                "-1 #",
                "&x *x",
            ):
                yield "\n".join([*head, f"{key}: {tag} {value}", *tail])
            yield "\n".join([*head, f"{key}:: {value}", *tail])
            yield "\n".join([*head, f"? {key}", *tail])


def load_or_refuse(path: Path) -> bool:
    """True if the file loads, False if it is refused with a place; anything else is an error."""
    try:
        make_plan(load_pipeline(path))
    except ConfigError as error:
        message = str(error)
    else:
        return True
    assert re.search(r"mutant\.yaml:\d+:\d+  ", message), message
    return False


@pytest.mark.slow
def test_no_mutation_of_the_shipped_pipeline_ends_in_a_traceback(tmp_path: Path) -> None:
    path = tmp_path / "mutant.yaml"
    outcomes = []
    for text in mutations((ROOT / "pipeline.yaml").read_text()):
        path.write_text(text)
        outcomes.append(load_or_refuse(path))
    assert len(outcomes) > 400
    assert outcomes.count(False) > 100


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.one_of(
        st.binary(max_size=60),
        st.text(max_size=60).map(str.encode),
        st.text(alphabet="stages:ik \n\t{}[]&*!-'\"|>#%@0123.~\\", max_size=80).map(
            lambda s: b"stages:\n" + s.encode()
        ),
    )
)
def test_no_file_at_all_ends_in_a_traceback(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "mutant.yaml"
    path.write_bytes(data)
    assert not load_or_refuse(path)
