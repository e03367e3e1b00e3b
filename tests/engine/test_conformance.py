"""A class that breaks the contract is refused when it is loaded, with its place and what was expected."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

from tactflow.engine import contract
from tactflow.engine.conformance import component
from tactflow.engine.contract import Recorder, Sink, Source, Stage, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Frame
from tactflow.ports import Image


class Good(Stage):
    memory = "pure"

    def process(self, image: Image) -> Image:
        return image


class GoodSink(Sink):
    def write(self, image: Image) -> None: ...


class GoodRecorder(Recorder):
    def write(self, image: Image) -> None: ...


class GoodSource(Source):
    def frames(self) -> Iterator[Frame]:
        yield from ()


def wrong(base: type[Any], **changes: Any) -> str:
    """What is said of a class like `base` with some of its attributes changed."""
    with pytest.raises(ConfigError) as caught:
        component(type("Changed", (base,), changes), "changed", "a test", {"when"})
    return str(caught.value)


@pytest.mark.parametrize(
    ("cls", "kind"),
    [
        (Good, "stage"),
        (GoodSink, "sink"),
        (GoodSource, "source"),
        (type("R", (Recorder, GoodSink), {}), "sink"),
    ],
)
def test_a_class_is_of_the_kind_that_it_inherits_from(cls: type, kind: str) -> None:
    assert component(cls, "it", "a test", ()).kind == kind


@pytest.mark.parametrize(
    ("base", "name", "value", "words"),
    [
        (Good, "memory", "none", "memory: required 'pure' or 'stateful', got 'none'"),
        (GoodSink, "threaded", "yes", "threaded: required True or False, got 'yes'"),
        (GoodSink, "when_live", "newest", "when_live: required 'block' or 'latest', got 'newest'"),
        (GoodSink, "queue_capacity", 0, "queue_capacity: required a whole number from 1, got 0"),
        (GoodSink, "queue_capacity", True, "queue_capacity: required a whole number from 1, got True"),
        (GoodSink, "observer", None, "observer: required True or False, got None"),
        (GoodSink, "description", 3, "description: required a text or None, got 3"),
        (GoodSource, "live", "no", "live: required True or False, got 'no'"),
        (Good, "reset", True, "reset: required a method, got True"),
        (Good, "Params", dict, "Params must be a subclass of tactflow.StageParams"),
    ],
)
def test_a_wrong_value_is_an_error(base: type, name: str, value: Any, words: str) -> None:
    assert words in wrong(base, **{name: value})


@pytest.mark.parametrize(
    ("base", "misspelt", "value", "meant"),
    [
        (GoodSink, "takes_reference", True, "takes_references"),
        (GoodSink, "when_life", "latest", "when_live"),
        (GoodSink, "queue_capasity", 3, "queue_capacity"),
        (GoodSink, "want", lambda self: id(self), "wants"),
        (Good, "resets", lambda self: id(self), "reset"),
    ],
)
def test_a_misspelt_name_is_an_error_that_says_what_was_meant(
    base: type, misspelt: str, value: Any, meant: str
) -> None:
    said = wrong(base, **{misspelt: value})
    assert re.search(rf"\.{misspelt}: a \w+ has no such attribute; did you mean {meant}\?", said)


@pytest.mark.parametrize(
    ("base", "own"),
    [
        (GoodSink, {"publish": lambda self: id(self), "output": "out.csv", "counter": 0}),
        (GoodSink, {"closed": property(bool), "frames": 0}),
        (GoodSource, {"total": property(id), "live": property(bool)}),
    ],
)
def test_names_of_another_sort_are_its_own(base: type, own: dict[str, Any]) -> None:
    cls = type("Own", (base,), own)
    assert component(cls, "own", "a test", ()).cls is cls


def test_a_property_of_the_contract_must_be_one() -> None:
    assert "missed: required a property; write @property above it" in wrong(
        GoodSource, missed=lambda self: id(self)
    )


def test_what_belongs_to_another_kind_is_an_error() -> None:
    assert "threaded: a stage has no such attribute" in wrong(Good, threaded=True)
    assert "memory: a sink has no such attribute" in wrong(GoodSink, memory="pure")


def test_parameters_under_another_name_are_an_error() -> None:
    assert "Parameters: nobody reads it" in wrong(Good, Parameters=type("Parameters", (StageParams,), {}))


def test_a_name_of_its_own_is_free() -> None:
    assert (
        component(type("Own", (Good,), {"gain": 2, "resize": lambda self: self}), "", "", ()).kind == "stage"
    )


def test_a_method_must_take_what_the_engine_gives_it() -> None:
    assert "reset: required (self), got (self, how)" in wrong(Good, reset=lambda self, how: (self, how))
    assert "outputs: required a class method" in wrong(GoodSink, outputs=lambda self, params: (self, params))


def test_a_method_that_must_be_awaited_is_an_error() -> None:
    async def wants(self: Sink) -> bool:
        return bool(self)

    assert "wants: async functions are not awaited" in wrong(GoodSink, wants=wants)


def test_a_missing_method_is_an_error() -> None:
    assert "a stage has a method process()" in wrong(Stage, memory="pure")
    assert "a sink has a method write()" in wrong(Sink)
    assert "a source has a method frames()" in wrong(Source)


def test_a_class_that_inherits_from_nothing_is_told_what_to_inherit_from() -> None:
    class Loose:
        def write(self, image: Image) -> None: ...

    with pytest.raises(ConfigError, match=r"test_conformance\.py:\d+: Loose must inherit from Sink"):
        component(Loose, "loose", "a test", ())


def test_every_mistake_of_a_class_is_reported_at_once() -> None:
    text = wrong(GoodSink, threaded=1, queue_capacity=-1)
    assert "threaded" in text
    assert "queue_capacity" in text


def test_a_parameter_cannot_be_called_like_a_key_of_the_pipeline_file() -> None:
    class Params(StageParams):
        when: int = 1

    assert "Params.when: that name is a key of the pipeline file" in wrong(Good, Params=Params)


def test_every_public_attribute_of_the_contract_is_documented() -> None:
    source = contract.__loader__.get_source(contract.__name__)  # type: ignore[union-attr]
    assert source is not None
    lines = source.splitlines()
    bare = [
        line.strip()
        for line, following in pairwise(lines)
        if line.startswith("    ") and ": ClassVar" in line and not following.strip().startswith('"""')
    ]
    assert not bare
