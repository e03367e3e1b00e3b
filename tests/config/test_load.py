"""A right pipeline file becomes the graph it describes; overrides change it and keep their provenance."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tactflow.config.load import load_pipeline
from tactflow.config.overrides import Override, from_settings
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Gate, Mark, OnError, Pipeline, Queue, Ref

PARTS = Path(__file__).with_name("parts.py")
BODY = """\
sensor: left
stages:
  capture: {use: './parts.py:Source'}
  prepare:
    use: ./parts.py:Prepare
    gamma: 2
    corners: [[1, 2], [3, 4]]
  compare: {use: './parts.py:Compare'}
  outline: {use: './parts.py:Outline', when: touching}
sinks:
  out: {use: './parts.py:Publish'}
"""

Load = Callable[..., Pipeline]


@pytest.fixture
def load(tmp_path: Path) -> Load:
    """Load a pipeline text with parts beside it."""
    shutil.copy(PARTS, tmp_path / "parts.py")

    def from_text(text: str = BODY, *overrides: Override | str, **options: Any) -> Pipeline:
        (tmp_path / "p.yaml").write_text(text)
        return load_pipeline(tmp_path / "p.yaml", overrides, **options)

    return from_text


def test_a_loose_file_of_the_command_line_is_relative_to_the_current_folder(
    load: Load, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (here / "mine.py").write_text(PARTS.read_text())
    monkeypatch.chdir(here)
    pipeline = load(BODY, "stages.outline.use=./mine.py:Outline")
    assert pipeline.nodes["outline"].component.cls.__module__.startswith("tactflow_file_mine")
    with pytest.raises(ConfigError, match=r"cannot read ./mine\.py"):
        load(BODY.replace("./parts.py:Outline", "./mine.py:Outline"))


def test_a_file_becomes_nodes_with_parameters_and_marks(load: Load, tmp_path: Path) -> None:
    pipeline = load()
    assert list(pipeline.nodes) == ["capture", "prepare", "compare", "outline", "out"]
    assert (pipeline.sensor, pipeline.skipping, pipeline.opencv_threads) == ("left", True, None)
    assert pipeline.directory == tmp_path
    assert pipeline.source.id == "capture"
    assert [sink.id for sink in pipeline.sinks] == ["out"]
    prepare = pipeline.nodes["prepare"]
    assert prepare.params.model_dump(include={"gamma", "corners"}) == {
        "gamma": 2.0,
        "corners": [(1.0, 2.0), (3.0, 4.0)],
    }
    assert prepare.mark == Mark(str(tmp_path / "p.yaml"), 4, 3)
    assert pipeline.warnings == []


def test_inputs_take_the_output_of_their_name(load: Load) -> None:
    nodes = load().nodes
    assert nodes["compare"].inputs == {"image": Ref("prepare", "image"), "frame": Ref("capture", "frame")}
    assert nodes["outline"].inputs == {"contact_mask": Ref("compare", "contact_mask")}
    assert nodes["out"].inputs == {"image": Ref("prepare", "image"), "contact": Ref("outline", "contact")}


def test_the_nearest_stage_above_wins_and_sinks_take_the_last(load: Load) -> None:
    nodes = load(BODY.replace("  compare:", "  invert: {use: './parts.py:Invert'}\n  compare:")).nodes
    assert nodes["invert"].inputs["image"] == Ref("prepare", "image")
    assert nodes["compare"].inputs["image"] == Ref("invert", "image")
    last = BODY.replace("sinks:", "  invert: {use: './parts.py:Invert'}\nsinks:")
    assert load(last).nodes["compare"].inputs["image"] == Ref("prepare", "image")
    assert load(last).nodes["out"].inputs["image"] == Ref("invert", "image")


def test_in_names_outputs_and_null_disconnects_an_optional_input(load: Load) -> None:
    text = BODY.replace("sinks:", "  invert: {use: './parts.py:Invert'}\nsinks:")
    for reference, stage in (("image", "invert"), ("prepare.image", "prepare")):
        inputs = load(text, f"sinks.out.in.image={reference}").nodes["out"].inputs
        assert inputs["image"] == Ref(stage, "image")
    assert load(text, "sinks.out.in.image=null").nodes["out"].inputs["image"] is None


def test_a_stage_with_nothing_after_its_name_has_the_defaults(load: Load) -> None:
    pipeline = load("stages:\n  capture:\n  preprocess:\nsinks:\n  jsonl:\n")
    assert pipeline.nodes["preprocess"].component.name == "preprocess"
    assert pipeline.sensor == "main"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("touching", [Gate(Ref("compare", "touching"), "no_contact")]),
        ("compare.touching", [Gate(Ref("compare", "touching"), "no_contact")]),
        ("[touching, compare.touching]", [Gate(Ref("compare", "touching"), "no_contact")] * 2),
        ("null", []),
    ],
)
def test_when_makes_gates(text: str, expected: list[Gate], load: Load) -> None:
    assert list(load(BODY, f"stages.outline.when={text}").nodes["outline"].gates) == expected


@pytest.mark.parametrize("times", [1, 2])
def test_a_gate_on_a_held_signal_has_the_reason_of_the_signal(times: int, load: Load) -> None:
    text = BODY
    for count in range(times):
        giver = f"held_{count - 1}.held" if count else "compare.touching"
        held = f"  held_{count}: {{use: hold, hold: 3, in: {{signal: {giver}}}}}\n"
        text = text.replace("  outline:", f"{held}  outline:")
    gates = load(text, "stages.outline.when=held").nodes["outline"].gates
    assert list(gates) == [Gate(Ref(f"held_{times - 1}", "held"), "no_contact")]


@pytest.mark.parametrize(
    ("override", "attribute", "expected"),
    [
        ("segment=heavy", "segment", "heavy"),
        ("queue={capacity: 4, when_full: drop_oldest}", "queue", Queue(capacity=4, when_full="drop_oldest")),
        ("queue.when_full=latest", "queue", Queue(when_full="latest")),
        ("on_error=disable", "on_error", OnError(action="disable")),
        ("on_error={action: skip_frame, budget: 3}", "on_error", OnError(action="skip_frame", budget=3)),
        ("max_rate=12.5", "max_rate", 12.5),
    ],
)
def test_the_engine_keys_of_a_sink(override: str, attribute: str, expected: Any, load: Load) -> None:
    assert getattr(load(BODY, f"sinks.out.{override}").nodes["out"], attribute) == expected


def test_a_viewer_is_disabled_by_an_error_and_other_sinks_stop_the_run(load: Load) -> None:
    nodes = load(BODY + "  view: {use: './parts.py:Viewer'}\n").nodes
    assert nodes["view"].on_error == OnError(action="disable")
    assert nodes["out"].on_error == OnError(action="stop")


def test_anchors_and_merge_keys_share_settings(load: Load) -> None:
    text = BODY.replace(
        "  outline: {use: './parts.py:Outline', when: touching}\n",
        "  outline: &o {use: './parts.py:Outline', min_area: 7, name: a}\n  again: {<<: *o, min_area: 8}\n",
    )
    nodes = load(text).nodes
    assert nodes["again"].params.model_dump() == {"min_area": 8, "name": "a"}
    assert nodes["outline"].params.model_dump() == {"min_area": 7, "name": "a"}


def test_an_override_of_an_aliased_value_changes_only_the_one_it_names(load: Load) -> None:
    text = BODY.replace("gamma: 2", "gamma: 2\n    lens: &lens {focal: 3}").replace(
        "  compare:", "  second: {use: './parts.py:Prepare', lens: *lens}\n  compare:"
    )
    nodes = load(text, "stages.second.lens.focal=9").nodes
    assert nodes["second"].params.model_dump()["lens"]["focal"] == 9
    assert nodes["prepare"].params.model_dump()["lens"]["focal"] == 3


@pytest.mark.parametrize(("text", "value"), [("1e-3", 0.001), ("1.5", 1.5), ("3", 3.0), ("+2E0", 2.0)])
def test_numbers_are_read_as_people_write_them(text: str, value: float, load: Load) -> None:
    assert (
        load(BODY.replace("gamma: 2", f"gamma: {text}")).nodes["prepare"].params.model_dump()["gamma"]
        == value
    )


@pytest.mark.parametrize(
    ("overrides", "node", "expected"),
    [
        (["stages.prepare.gamma=3"], "prepare", {"gamma": 3}),
        (["stages.prepare.gamma=3", "stages.prepare.gamma=4"], "prepare", {"gamma": 4}),
        (["stages.prepare.corners=[[5, 6]]"], "prepare", {"corners": [(5, 6)]}),
        (["stages.prepare.rotate=90"], "prepare", {"rotate": 90}),
        (["sinks.out.path=2026-11-21"], "out", {"path": "2026-11-21"}),
        (["sinks.more={use: './parts.py:Publish', path: b}"], "more", {"path": "b"}),
    ],
)
def test_set_replaces_and_adds_values(
    overrides: list[str], node: str, expected: dict[str, Any], load: Load
) -> None:
    params = load(BODY, *overrides).nodes[node].params.model_dump()
    assert {name: params[name] for name in expected} == expected


def test_set_adds_and_removes_stages_and_changes_the_top_level(load: Load) -> None:
    added = load(BODY, "stages.extra.use=./parts.py:Invert", "sinks.second.use=./parts.py:Viewer").nodes
    assert added["second"].inputs["image"] == Ref("extra", "image")
    removed = load(BODY, "stages.outline=null", "sinks.out=null")
    assert list(removed.nodes) == ["capture", "prepare", "compare"]
    assert "there are no sinks" in removed.warnings[0]
    changed = load(BODY, "sensor=right", "skipping=false", "opencv_threads=2")
    assert (changed.sensor, changed.skipping, changed.opencv_threads) == ("right", False, 2)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("stages.prepare.gamma=x", "stages.prepare.gamma: should be a valid number, got 'x'"),
        ("stages.outlin=null", "there is no stage 'outlin' to remove; did you mean outline?"),
        ("sink.out.path=a", "sink: unknown key; did you mean sinks?"),
        ("stages.prepare.gamma.x=3", "stages.prepare.gamma is 2, so it has no x"),
        ("stages.prepare.corners.1=3", "stages.prepare.corners is a list, so it has no 1; replace it as a"),
        ("stages.prepare.gamma", "expected a.b.c=VALUE"),
        ("stages.prepare.gamma={", "not valid YAML"),
    ],
)
def test_a_mistake_in_set_names_the_option(override: str, words: str, load: Load) -> None:
    with pytest.raises(ConfigError) as caught:
        load(BODY, override)
    message = str(caught.value)
    assert message.startswith(f"--set {override}: ")
    assert words in message


def test_a_program_gives_python_values_and_a_mistake_names_its_settings(load: Load) -> None:
    corners = np.float32([[1, 2], [3, 4]])
    given = from_settings({"stages.prepare.corners": corners, "sinks.out.path": Path("a"), "sinks.x": {}})
    with pytest.raises(ConfigError, match=r"^settings: sinks\.x: there is no sink called x"):
        load(BODY, *given)
    nodes = load(BODY, *given[:2], *from_settings({"stages.outline": None})).nodes
    assert nodes["prepare"].params.model_dump()["corners"] == [(1.0, 2.0), (3.0, 4.0)]
    assert nodes["out"].params.model_dump()["path"] == "a"
    assert "outline" not in nodes


class TestOptionsOfTheCommandLine:
    def test_an_added_sink_gets_an_id_that_is_free(self, load: Load) -> None:
        text = BODY.replace("  out:", "  jsonl:")
        nodes = load(text, extra_sinks={"--jsonl": {"path": "-"}}).nodes
        assert nodes["jsonl"].component.name == "./parts.py:Publish"
        assert nodes["jsonl_2"].component.name == "jsonl"
        assert nodes["jsonl_2"].mark == Mark("--jsonl", 0, 0)

    def test_a_mistake_in_an_added_sink_names_the_option(self, load: Load) -> None:
        with pytest.raises(
            ConfigError, match=r"^--jsonl: sinks\.jsonl\.path: should be a valid string, got 3"
        ):
            load(BODY, extra_sinks={"--jsonl": {"path": 3}})


def test_no_sinks_are_a_warning_with_its_place(load: Load, tmp_path: Path) -> None:
    head, _, _ = BODY.partition("sinks:")
    assert load(head).warnings == [
        f"{tmp_path / 'p.yaml'}:1:1  there are no sinks, so nothing will be computed"
    ]
    assert load(head + "sinks: {}\n").warnings[0].startswith(f"{tmp_path / 'p.yaml'}:10:1  ")


def test_a_validator_that_breaks_is_reported_without_a_traceback(load: Load, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        PARTS.read_text().replace('raise ValueError("size needs corners")', "return {}[self.size]")
    )
    with pytest.raises(
        ConfigError, match=r"stages\.prepare: the parameters fail: KeyError: \(3, 4\) \(.*own\.py:\d+\)"
    ):
        load(
            BODY.replace("parts.py:Prepare", "own.py:Prepare"),
            "stages.prepare.corners=[]",
            "stages.prepare.size=[3, 4]",
        )


def with_sinks(first: str, second: str = "") -> str:
    """The body with other sinks."""
    return BODY.replace("out: {use: './parts.py:Publish'}", f"{first}\n  {second}")


@pytest.mark.parametrize(
    ("second", "clash"),
    [
        ("again: {use: jsonl, path: out/../out/a.jsonl}", True),
        ("more: {use: jsonl, path: ./out/a.jsonl, detail: true}", True),
        ("again: {use: jsonl, path: out/b.jsonl}", False),
    ],
)
def test_two_sinks_do_not_write_the_same_file(second: str, clash: bool, load: Load) -> None:
    text = with_sinks(first="lines: {use: jsonl, path: out/a.jsonl}", second=second)
    if clash:
        with pytest.raises(ConfigError, match=r"/out/a.jsonl is written by lines \(.*p.yaml:11:3\)"):
            load(text)
    else:
        assert len(load(text).sinks) == 2


@pytest.mark.parametrize("link", [None, os.symlink])
@pytest.mark.parametrize(
    ("read", "what"), [("press[1].npy", "what stages.capture reads"), ("p.yaml", "the pipeline file")]
)
def test_a_sink_never_writes_over_what_the_run_reads(
    read: str, what: str, link: Callable[[Path, Path], None] | None, load: Load, tmp_path: Path
) -> None:
    np.save(tmp_path / "press[1].npy", np.zeros((2, 60, 80, 3), np.uint8))
    (tmp_path / "p.yaml").touch()
    target = tmp_path / read
    if link:
        target = tmp_path / "results.jsonl"
        link(tmp_path / read, target)
    source = "'./parts.py:Source', source: 'press[1].npy?start=0'"
    text = BODY.replace("'./parts.py:Source'", source) + f"  jsonl: {{path: '{target}', overwrite: true}}\n"
    with pytest.raises(ConfigError, match=rf"p\.yaml:12:3  sinks\.jsonl: .* is {what}; choose another path"):
        load(text)
    assert (tmp_path / "p.yaml").read_text() == text
