"""A class that breaks the contract is refused when it is loaded, with its place and what was expected."""

from __future__ import annotations

from typing import Any

import pytest

from tactflow.engine.conformance import build, component
from tactflow.engine.contract import Sink, Source, Stage, StageParams
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Delivery
from tactflow.ports import Image


class Good(Stage):
    memory = "pure"

    def process(self, image: Image) -> Image:
        return image


class TakenKey(StageParams):
    when: int = 1


def wrong(base: type[Any], **changes: Any) -> str:
    """What is said of a class like `base` with some of its attributes changed."""
    with pytest.raises(ConfigError) as caught:
        component(type("Changed", (base,), changes), "changed", "a test", {"when"})
    return str(caught.value)


@pytest.mark.parametrize(
    ("base", "changes", "words"),
    [
        (Stage, {"memory": "pure"}, "a stage has a method process(), whose annotations are its ports"),
        (Sink, {}, "a sink has a method write()"),
        (Source, {}, "a source has a method frames(), which yields its frames"),
        (Good, {"memory": "none"}, 'must declare memory = "pure" (its outputs depend on its inputs alone)'),
        (Good, {"Params": dict}, "Params must be a subclass of tactflow.StageParams"),
        (Good, {"Params": TakenKey}, "Params.when: that name is a key of the pipeline file"),
    ],
)
def test_a_class_that_breaks_the_contract_is_refused(base: type, changes: Any, words: str) -> None:
    assert words in wrong(base, **changes)


def test_a_class_without_a_base_is_refused_with_its_place() -> None:
    class Loose:
        def write(self, image: Image) -> None: ...

    with pytest.raises(ConfigError, match=r"test_conformance\.py:\d+: Loose must inherit from Stage, Sink"):
        component(Loose, "loose", "a test", ())


def test_a_constructor_is_given_what_it_asks_for_and_cannot_lose_its_parameters() -> None:
    class Named(Good):
        def __init__(self, _: StageParams, sensor: str) -> None:
            self.sensor = sensor

    params = StageParams()
    built: Any = build(Named, params, {"sensor": "left", "skipping": True})
    assert (built.sensor, built.params) == ("left", params)


def test_a_component_with_further_arguments_passes_them_on_and_still_gets_what_it_asks_for() -> None:
    class Opened(Good):
        def __init__(self, _: StageParams, sensor: str, opener: str = "none") -> None:
            self.sensor, self.opener = sensor, opener

    plain = component(Opened, "opened", "a test", ())
    built: Any = build(plain.with_arguments(opener="mine").make, StageParams(), {"sensor": "left"})
    assert (built.sensor, built.opener) == ("left", "mine")
    assert type(built) is plain.cls


def test_how_frames_are_delivered_to_a_sink_is_read_from_its_class() -> None:
    class Slow(Sink):
        threaded = True
        queue_capacity = 9

        def write(self, image: Image) -> None: ...

    assert component(Slow, "slow", "a test", ()).delivery == Delivery(threaded=True, queue_capacity=9)
    assert component(Good, "good", "a test", ()).delivery == Delivery()
