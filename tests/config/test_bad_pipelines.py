"""Every mistake in a pipeline file is reported with its place, with exit code 2 and without a traceback."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from tests.terminal import Terminal

ROOT = Path(__file__).resolve().parents[2]
PARTS = Path(__file__).with_name("parts.py")
HERE = "§"
"""Stands in a case's text where the mistake must be found; it is taken out before the file is written."""

HEAD = "stages:\n  capture: {use: @Source}\n"
SINK = "sinks:\n  out: {use: @Publish}\n"
PREPARE = HEAD + "  prepare: {use: @Prepare}\n"
COMPARE = PREPARE + "  compare: {use: @Compare}\n"
BASES = {"file": "", "top": "", "source": HEAD, "prepare": PREPARE, "compare": COMPARE}
"""Name -> the lines above those of a case; `top` has the lines of a case above all others."""

CASES = [
    ("file", "§", "the file is empty .. required"),
    ("file", "§- capture\n- hull", "expected a mapping .. got a list"),
    ("file", "stages:\n§\tcapture: {}", "tab character .. blanks"),
    ("file", "sensor: 'main\nstages: {}\n§", "not valid YAML .. starts in line 1"),
    ("file", "sensor: a§: b", "not valid YAML .. quotes"),
    ("file", "sinks:\n  out: {use: @Publish}\n§---\nstages:\n  capture: {use: @Source}", "another document"),
    ("file", "sensor: §*name", "undefined alias"),
    ("file", "sensor: §!!python/object/apply:os.getcwd []", "!!python/object/apply:os.getcwd .. not allowed"),
    ("file", "§stages: &all\n  capture: *all", "nested too deeply"),
    ("file", 'sensor: "a§\x01b"', "#x0001 .. not allowed .. UTF-8"),
    ("top", "sensor: a\n§sensor: b", "sensor: duplicate key .. line 1"),
    ("source", "  §yes: {}", "a key must be text .. quotes"),
    ("file", "§sensor: main", "stages: required, but not given .. id -> stage"),
    ("file", "§stages:\n  - capture\nSINK", "stages: should be a mapping .. got a list"),
    ("file", "§stages: {}\nSINK", "no source of frames .. capture"),
    ("source", "  §prepare: fast", "stages.prepare: should be a mapping .. got 'fast'"),
    ("source", "  §a.b: {}", "stages.a.b: should be a word"),
    (
        "source",
        "sinks:\n  §capture: {use: @Publish}",
        "the id capture is taken by stages.capture .. bad.yaml:2:3",
    ),
    ("top", "§skipping: 1", "skipping: should be a valid boolean, got 1"),
    (
        "source",
        "  prepare: {use: @Prepare, queue: {§when_full: lates}}",
        "when_full: should be 'block', 'latest' or 'drop_oldest' .. did you mean latest?",
    ),
    ("source", "  prepare: {use: @Prepare, queue: {§capcity: 2}}", "unknown key; did you mean capacity?"),
    ("source", "  prepare: {use: @Prepare, §max_rate: 5}", "stages.prepare.max_rate: unknown parameter"),
    ("source", "  §teleport:", "stages.teleport: there is no stage called teleport .. ./file.py:Class"),
    ("source", "  §jsonl:", "jsonl is under stages: but belongs under sinks:"),
    ("source", "sinks:\n  out: {§use: @Prepare}", "is a stage; it belongs under stages:"),
    ("source", "  a: {§use: './nowhere.py:A'}", "cannot read ./nowhere.py .. No such file"),
    ("source", "  a: {§use: @Prepar}", "no class Prepar .. did you mean Prepare?"),
    ("prepare", "  a: {§use: @Bare}", "Bare.process .. parameter image has no annotation"),
    ("prepare", "  §a: {use: @Needy}", "stages.a.path: required, but not given"),
    ("source", "  p: {use: @Prepare, §gamma: yes}", "should be a valid number, got true"),
    ("source", "  p: {use: @Prepare, §gamma: .nan}", "should be a finite number"),
    ("source", "  p:\n    use: @Prepare\n    §gamma:", "got nothing"),
    (
        "source",
        "  p:\n    use: @Prepare\n    corners:\n      - [1, 2]\n      - [3, §x]",
        "stages.p.corners.1.1: should be a valid number, got 'x'",
    ),
    (
        "source",
        "  p: {use: @Prepare, corners: [[1, 2], §[3]]}",
        "stages.p.corners.1.1: required, but not given",
    ),
    (
        "source",
        "  p: {use: @Prepare, lens: {focal: 3, §fishey: true}}",
        "stages.p.lens.fishey: unknown parameter",
    ),
    (
        "file",
        "stages:\n  capture: {use: @Source, §source: [0]}\nSINK",
        "stages.capture.source: should be a valid string or a valid integer, got a list",
    ),
    ("source", "  §p: {use: @Prepare, size: [3, 4]}", "stages.p: size needs corners"),
    ("source", "  §second: {use: @Source}", "one source .. capture ( .. bad.yaml:2:3"),
    (
        "prepare",
        "  §outline: {use: @Outline}",
        "needs contact_mask, but no stage above gives it .. frame (capture), image (prepare) .. difference",
    ),
    (
        "prepare",
        "  §outline: {use: @Outline}\n  compare: {use: @Compare}",
        "compare gives it but is below .. in: {contact_mask: compare.contact_mask}",
    ),
    ("prepare", "sinks:\n  §out: {use: @Require}", "needs contact, but no stage gives it"),
    (
        "compare",
        "  o: {use: @Outline, in: {§contactmask: compare.contact_mask}}",
        "o has no input contactmask; did you mean contact_mask?",
    ),
    (
        "compare",
        "  o: {use: @Outline, in: {§contact_mask: compar.contact_mask}}",
        "there is no stage 'compar'; did you mean compare?",
    ),
    (
        "compare",
        "  o: {use: @Outline, in: {§contact_mask: compare.mask}}",
        "compare ( .. bad.yaml:4:3 .. has no output 'mask' .. contact_mask",
    ),
    (
        "compare",
        "  o: {use: @Outline, in: {§contact_mask: compare}}",
        "compare is the name of a stage; required an output, compare.contact_mask or compare.touching",
    ),
    ("compare", "  o: {use: @Outline, in: {§contact_mask: out.x}}", "has no output 'x'"),
    ("compare", "  o: {use: @Outline, in: {§contact_mask: null}}", "in.contact_mask: this input is required"),
    (
        "compare",
        "  o: {use: @Outline, in: {§contact_mask: prepare.image}}",
        "takes (H, W) uint8 .. prepare.image .. bad.yaml:3:3 .. gives (H, W, 3) uint8",
    ),
    (
        "compare",
        "  a: {use: @Refine, in: {§contact: b.contact}}\n  b: {use: @Refine}",
        "stages.a: the stages form a cycle, a -> b -> a",
    ),
    (
        "prepare",
        "  invert: {use: @Invert, §when: compare.touching}\n  compare: {use: @Compare}",
        "form a cycle, invert -> compare -> invert",
    ),
    ("compare", "  o: {use: @Outline, §when: toching}", "did you mean touching?"),
    ("compare", "  o: {use: @Outline, §when: image}", "a gate takes a signal .. prepare.image .. (H, W, 3)"),
    (
        "prepare",
        "  i: {use: @Invert, §when: touching}\n  compare: {use: @Compare}",
        "no stage above gives touching; write compare.touching",
    ),
    ("file", "stages:\n  capture: {use: @Source, §when: touching}\nSINK", "a source cannot be gated"),
    ("compare", "  o: {use: @Outline, §when: {signal: touching}}", "should be a valid string or a list"),
    (
        "prepare",
        "  §compare: {use: @Compare, segment: a}\n  outline: {use: @Outline, segment: b}\n"
        "  refine: {use: @Refine, segment: a}",
        "compare: the segments a (compare, refine) and b (outline) form a cycle",
    ),
    (
        "source",
        "  prepare: {use: @Prepare, queue: {capacity: 2}}\n"
        "  §compare: {use: @Compare, queue: {capacity: 3}}\n  outline: {use: @Outline}",
        "compare.queue: its segment has a queue already, that of prepare",
    ),
]
"""Base, lines with the mark where the mistake is, and what the message says, in parts."""


def pipeline(text: str, base: str = "file") -> str:
    """A pipeline file; @Prepare stands for the class of that name in parts.py."""
    text = BASES[base] + text.replace("SINK", SINK) + ("" if text.endswith(HERE) and base == "file" else "\n")
    if base != "file":
        text += (HEAD if base == "top" else "") + ("" if "sinks:" in text else SINK)
    return re.sub(r"@([A-Z]\w*)", r"'./parts.py:\1'", text)


@pytest.fixture(autouse=True)
def parts(terminal: Terminal) -> None:
    """The current folder has the parts in it."""
    assert not terminal.out
    shutil.copy(PARTS, "parts.py")


@pytest.mark.parametrize(("base", "text", "words"), CASES)
def test_a_mistake_is_reported_at_its_place(base: str, text: str, words: str, terminal: Terminal) -> None:
    before, _, after = pipeline(text, base).partition(HERE)
    Path("bad.yaml").write_text(before + after)
    line = before.count("\n") + 1
    column = len(before) - before.rfind("\n")
    assert terminal("check", "bad.yaml") == 2
    out, err = terminal.out, terminal.err
    assert out == ""
    assert "Traceback" not in err
    found, *below = err[err.index(f"bad.yaml:{line}:{column}  ") :].splitlines()
    lines = (before + after).splitlines()
    if line <= len(lines):
        # The caret stands under the mistake.
        assert len(below[0]) - below[1].index("^") == len(lines[line - 1]) - column + 1
    for part in words.split(" .. "):
        assert part in found


@pytest.mark.parametrize("command", ["run", "check", "explain", "graph"])
def test_every_command_that_reads_a_pipeline_refuses_a_bad_one(command: str, terminal: Terminal) -> None:
    Path("bad.yaml").write_text(pipeline("  prepare: {}", "source"))
    assert terminal(command, "bad.yaml", "--set", "sinks.out.path=3") == 2
    out, err = terminal.out, terminal.err
    assert out == ""
    assert "bad.yaml:3:3  stages.prepare: there is no stage called prepare" in err
    assert "--set sinks.out.path=3: sinks.out.path: should be a valid string, got 3" in err
    assert "Traceback" not in err


def test_all_mistakes_come_at_once_in_the_order_of_the_file(terminal: Terminal) -> None:
    Path("bad.yaml").write_text(
        pipeline("sensor: a b\n" + PREPARE + "  o: {use: @Outline, min_aera: 3, when: tuching}\nsink: {}")
    )
    assert terminal("check", "bad.yaml") == 2
    err = terminal.err
    places = re.findall(r"^bad\.yaml:(\d+):\d+  ", err, re.MULTILINE)
    assert places == ["1", "5", "5", "5", "6"]
    assert err.startswith("tactflow: 5 mistakes\n")


def test_bytes_that_are_not_utf8_have_a_place(terminal: Terminal) -> None:
    Path("bad.yaml").write_bytes(b"sensor: main\nskipping: \xff\n")
    assert terminal("check", "bad.yaml") == 2
    assert "bad.yaml:2:11  the character #xdcff is not allowed" in terminal.err


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("nowhere.yaml", "there is no file nowhere.yaml"),
        (".", "is a folder"),
        ("parts.py/x", "cannot read"),
        ("long.yaml", "cannot read long.yaml: larger than 1024 KiB"),
        ("/dev/zero", "larger than 1024 KiB" if Path("/dev/zero").exists() else "there is no file"),
    ],
)
def test_a_file_that_cannot_be_read(argument: str, words: str, terminal: Terminal) -> None:
    Path("long.yaml").write_text("stages:\n" + "- a\n" * 300_000)
    assert terminal("check", argument) == 2
    assert words in terminal.err


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("class A:\n    def process(self\n", r"own\.py:2: cannot load \./own\.py: '\(' was never closed"),
        ("import no_such_thing\n", r"own\.py:1: cannot load \./own\.py: ModuleNotFoundError"),
        ("x = 1\ny = x / 0\n", r"own\.py:2: cannot load \./own\.py: ZeroDivisionError"),
        ("raise SystemExit(5)\n", r"own\.py:1: cannot load \./own\.py: SystemExit"),
        ("class _A:\n    def process(self): ...\n", r"own\.py has no public class that inherits from Stage"),
    ],
)
def test_a_mistake_in_an_own_file_is_shown_with_its_line(body: str, words: str, terminal: Terminal) -> None:
    Path("own.py").write_text(body)
    Path("bad.yaml").write_text(pipeline("  own: {use: ./own.py}", "prepare"))
    assert terminal("check", "bad.yaml") == 2
    err = terminal.err
    assert "bad.yaml:4:9  stages.own.use: " in err
    assert re.search(words, err), err
    assert "Traceback" not in err
