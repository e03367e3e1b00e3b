"""Ports are read from annotations, and their types decide what fits together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from tactflow.engine.errors import ConfigError
from tactflow.engine.frame import Absent, Frame, Tick
from tactflow.engine.ports import ArrayPort, Port, ResultParameter, SignalPort, fits, port_type, read_ports
from tactflow.ports import ContactMask, Image, Picture, Touching
from tactflow.vision.types import Contact, Flow

if TYPE_CHECKING:
    from tactflow.vision.types import Ellipse

Grey = Annotated[NDArray[np.uint8], ArrayPort("grey", ("H", "W"), "uint8", "grey levels")]
AnyChannels = Annotated[NDArray[np.uint8], ArrayPort("any", ("H", "W", "C"), "uint8", "grey levels, BGR")]
FloatMask = Annotated[NDArray[np.float32], ArrayPort("mask", ("H", "W"), "float32", "0 or 255")]
Moving = Annotated[bool, SignalPort("moving", closed="still")]


class Masks(NamedTuple):
    contact_mask: ContactMask
    contact: Contact | None
    touching: Touching


class RawField(NamedTuple):
    picture: NDArray[np.uint8]


class HiddenField(NamedTuple):
    ellipse: Ellipse


class HTTPStatusCode:
    pass


def outputs(annotation: Any) -> list[tuple[str, bool]]:
    class Stage:
        def process(self, image: Image) -> Any: ...

    Stage.process.__annotations__["return"] = annotation
    return [(port.name, port.optional) for port in read_ports(Stage, "process").outputs]


def test_parameters_are_input_ports_and_none_makes_them_optional() -> None:
    class Stage:
        def process(self, image: Image, contact: Contact | None, flow: Flow | None = None) -> Contact: ...

    ports = read_ports(Stage, "process")
    assert [(port.name, port.optional) for port in ports.inputs] == [
        ("image", False),
        ("contact", True),
        ("flow", True),
    ]
    assert port_type(ports.inputs[0].annotation).name == "image"
    assert ports.inputs[1].annotation is Contact
    assert ports.result is None


@pytest.mark.parametrize(
    ("annotation", "expected"),
    [
        (Contact, [("contact", False)]),
        (Contact | Absent, [("contact", True)]),
        (Contact | None, [("contact", True)]),
        (Picture, [("annotated", False)]),
        (Picture | Absent, [("annotated", True)]),
        (Touching, [("touching", False)]),
        (HTTPStatusCode, [("http_status_code", False)]),
        (Masks, [("contact_mask", False), ("contact", True), ("touching", False)]),
        (Masks | Absent, [("contact_mask", True), ("contact", True), ("touching", True)]),
    ],
)
def test_the_return_annotation_names_the_output_ports(
    annotation: Any, expected: list[tuple[str, bool]]
) -> None:
    assert outputs(annotation) == expected


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (np.ndarray, "a bare array does not say what it holds"),
        (NDArray[np.uint8], "a bare array does not say what it holds"),
        (RawField, "RawField.picture: a bare array"),
        (HiddenField, "the annotations of HiddenField use Ellipse"),
        (float, "gives the output port no name; return a NamedTuple with a field for it, as in brightness"),
        (bool, r'is Annotated\[bool, SignalPort\("name", closed="reason"\)\]'),
        (dict[str, int], "gives the output port no name"),
        (Any, "gives the output port no name"),
        (Contact | Flow, "required one type for one port"),
        (Absent, "required one type for one port"),
    ],
)
def test_a_return_annotation_that_names_no_port_is_an_error(annotation: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        outputs(annotation)


class Found(Tick):
    contact: Contact | None
    touching: Touching | None


def test_a_sink_may_take_a_result_with_the_ports_that_its_class_names() -> None:
    class Sink:
        def write(self, result: Found, touching: Touching, image: Image) -> None: ...

    ports = read_ports(Sink, "write")
    # A port that is named beside the result is required or not as it stands there.
    assert [(p.name, p.optional) for p in ports.inputs] == [
        ("contact", True),
        ("touching", False),
        ("image", False),
    ]
    assert ports.result == ResultParameter(1, Found)
    assert ports.outputs == ()


def test_a_source_gives_the_port_frame() -> None:
    class Source:
        def frames(self) -> Iterator[Frame]: ...

    ports = read_ports(Source, "frames")
    assert (ports.inputs, ports.outputs) == ((), (Port("frame", Frame),))


class Broken:
    """Methods whose annotations break the contract."""

    def tick(self, tick: Tick) -> Contact: ...

    def bare_result(self, result): ...  # type: ignore[no-untyped-def]

    def no_input(self) -> Contact: ...

    def no_return(self, image: Image): ...  # type: ignore[no-untyped-def]

    def default(self, image: Image, gain: float = 1.0) -> Contact: ...

    def hidden_name(self, ellipse: Ellipse) -> Contact: ...

    def bare_input(self, image: NDArray[np.uint8]) -> Contact: ...

    def absent_input(self, contact: Contact | Absent) -> Flow: ...


@pytest.mark.parametrize(
    ("function", "method", "words"),
    [
        (Broken.tick, "process", "only a sink may take a result"),
        (Broken.bare_result, "write", "result has no annotation; .* is annotated result: Result"),
        (Broken.no_input, "process", "needs at least one input"),
        (Broken.no_return, "process", "no return annotation"),
        (Broken.default, "process", "gain has a default"),
        (Broken.hidden_name, "process", "use Ellipse, which is not known when the program runs"),
        (Broken.bare_input, "process", "image: a bare array"),
        (Broken.absent_input, "process", r"annotated X \| None"),
    ],
)
def test_annotations_that_break_the_contract_are_reported_with_their_line(
    function: Any, method: str, words: str
) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        read_ports(type("Stage", (), {method: function}), method)
    assert str(caught.value).startswith(f"{__file__}:{function.__code__.co_firstlineno}: Stage.{method}: ")


@pytest.mark.parametrize(
    ("given", "wanted", "expected"),
    [
        (Image, Image, True),
        (Image, AnyChannels, True),
        (AnyChannels, Image, False),
        (Image, ContactMask, False),
        (Grey, ContactMask, False),
        (FloatMask, ContactMask, False),
        (Touching, Moving, True),
        (Touching, bool, True),
        (bool, Touching, False),
        (Contact, Contact, True),
        (Contact, Flow, False),
        (bool, int, True),
        (int, bool, False),
        (Contact, object, True),
        (Image, Any, True),
        (Image, Contact, False),
        (Contact, Image, False),
        (list[int], list[int], True),
        (list[int], list[str], False),
    ],
)
def test_an_output_fits_an_input_of_its_type(given: Any, wanted: Any, expected: bool) -> None:
    assert fits(Port("given", given), Port("wanted", wanted)) == expected
