"""The result message and its schema."""

from __future__ import annotations

import json
import math
import runpy
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from tactflow.engine.frame import Frame, Tick
from tactflow.message import encoding
from tactflow.message import fields as fields_module
from tactflow.message import result as result_module
from tactflow.message.fields import STATUS_NAMES
from tactflow.message.result import Result, encode_message
from tactflow.message.schema import message_schema
from tactflow.vision.flow import FieldModel
from tactflow.vision.types import Contact, Depth, Ellipse, Flow, Force, Markers, Pose, Scale, Slip
from tests.messages import CONTACT, FLOW, MARKERS, PROCESSED, SHEAR, Results, build_message, result_of

VALIDATOR = jsonschema.Draft202012Validator(message_schema())

REPOSITORY = Path(__file__).resolve().parents[2]
RAW = np.zeros((600, 800, 3), np.uint8)
TICK = Tick(Frame("main", 36, 1.2, RAW))


def test_the_message_has_exactly_the_fields_of_the_contract() -> None:
    message = build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS))
    assert message == {
        "schema": "tactflow.frame/1",
        "sensor": "main",
        "seq": 36,
        "t": 1.2,
        "size": [300, 400],
        "contact": {
            "area": 5123.5,
            "center": [150.2, 201.7],
            "angle": -12.31,
            "slope": 0.218,
            "hull": [[1.0, 2.0], [3.0, 4.5], [0.1, 9.0]],
            "ellipse": {"center": [150.0, 200.0], "axes": [90.5, 60.25], "angle": -12.9},
            "evidence": "both",
        },
        "contacts": [message["contact"]],
        "flow": {"mean": [1.21, -0.33], "count": 9},
        "markers": {
            "origin": [[10.0, 20.0], [30.0, 40.0], [50.0, 60.0]],
            "position": [[10.5, 20.5], [30.25, 40.0], [50.0, 61.0]],
            "status": ["tracked", "inferred", "lost"],
        },
        "skipped": {},
    }
    VALIDATOR.validate(message)


def test_detail_adds_what_is_documented_and_nothing_else() -> None:
    plain = build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS))
    detailed = build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS), detail=True)
    VALIDATOR.validate(detailed)
    flow = {"stderr": [0.1, 0.2], "rotation": 3.5, "divergence": 0.01, "residual": 0.05}
    assert detailed["contacts"] == [detailed["contact"]]
    assert detailed["contact"] == plain["contact"] | {"confidence": 0.75}
    assert detailed["flow"] == plain["flow"] | flow | SHEAR | {"shear": [0.02, -0.01]}
    assert detailed["markers"] == plain["markers"] | {"stderr": [0.02, None, None]}


@pytest.mark.parametrize("detail", [False, True])
@pytest.mark.parametrize(
    ("contact", "flow", "markers"),
    [
        (None, None, None),
        (None, None, MARKERS),
        (CONTACT, None, None),
        (replace(CONTACT, angle=None, slope=None, ellipse=None, area=0.0, hull=np.zeros((1, 2))), None, None),
        (replace(CONTACT, angle=90.0, slope=None, ellipse=Ellipse((1, 2), (5, 5), None)), None, None),
        (CONTACT, Flow(None, 0), MARKERS),
        (CONTACT, Flow((0.0, 0.0), 1), None),
        (None, None, Markers(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.uint8), np.zeros(0))),
    ],
)
def test_whatever_is_unknown_is_null_and_the_message_stays_valid(
    contact: Contact | None, flow: Flow | None, markers: Markers | None, detail: bool
) -> None:
    message = build_message(TICK, Results(PROCESSED, contact, flow, markers), detail=detail)
    VALIDATOR.validate(message)
    assert (message["contact"] is None) == (contact is None)
    assert (message["flow"] is None) == (flow is None)
    assert (message["markers"] is None) == (markers is None)


def test_the_field_is_part_of_the_message_on_request() -> None:
    origin = np.array([[20.0, 20], [40, 20], [20, 40], [40, 40]])
    markers = Markers(origin, origin + np.array([1.0, 0.5]), np.zeros(4, np.uint8), np.full(4, 0.02))
    field = FieldModel(origin, (60, 60))(markers)
    assert field is not None
    results = Results(PROCESSED, CONTACT, FLOW, markers, field=field)
    assert "field" not in build_message(TICK, results, detail=True)
    message = json.loads(encode_message(result_of(TICK, results), field=True))
    VALIDATOR.validate(message)
    rows, columns = field.grid.shape
    assert np.array(message["field"]["displacement"]).shape == (rows, columns, 2)
    assert np.array(message["field"]["stderr"]).shape == (rows, columns)
    grid = message["field"]
    last = np.array(grid["first"]) + grid["spacing"] * np.array([columns - 1, rows - 1])
    assert last == pytest.approx(field.grid.points[-1, -1])
    empty = json.loads(encode_message(result_of(TICK, Results(PROCESSED)), field=True))
    VALIDATOR.validate(empty)
    assert empty["field"] is None


POSE = Pose(
    "tracked", 12, (0.5, -1.0, -0.4), (0.1, 0.0, -0.2), (0.0, 1.5, 4.0), np.diag(np.arange(1.0, 7.0) ** 2)
)


FORCE = Force((None, 0.5, 2.5), (None, 0.1, 0.2), True)
OPTIONAL = {
    "float | None": 0.5,
    "int | None": 3,
    "tuple[float, float] | None": (0.5, 0.25),
    "SlipKind | None": "creeping",
    "NDArray[np.float64] | None": np.array([0.999, 0.7, math.nan]),
}
"""A value for each type of optional attributes."""
NOT_SENT = ("radius",)


@pytest.mark.parametrize(
    ("port", "part"),
    [
        *(("contact", CONTACT), ("flow", FLOW), ("markers", MARKERS)),
        *(("slip", Slip(True, 0.5)), ("force", FORCE), ("pose", POSE)),
    ],
)
def test_every_attribute_is_in_the_detailed_message_and_read_back(port: str, part: Any) -> None:
    optional = {
        f.name: OPTIONAL[f.type] for f in fields(part) if f.default is None and f.name not in NOT_SENT
    }
    complete = replace(part, **optional)
    message = build_message(TICK, Results(PROCESSED, **{port: complete}), detail=True)
    VALIDATOR.validate(message)
    read = getattr(Result.from_message(message), port)
    np.testing.assert_equal(asdict(read), asdict(complete))
    short = build_message(TICK, Results(PROCESSED, **{port: complete}))[port]
    assert short.keys() <= message[port].keys()


def test_a_force_has_its_errors_and_null_where_a_component_is_unknown() -> None:
    force = Force((None, None, 2.5), (None, None, 0.2), True)
    message = build_message(TICK, Results(PROCESSED, CONTACT, force=force))
    VALIDATOR.validate(message)
    assert message["force"] == {"value": [None, None, 2.5], "stderr": [None, None, 0.2], "in_range": True}
    assert "force" not in build_message(TICK, Results(PROCESSED, CONTACT))
    drifted = build_message(TICK, Results(PROCESSED, CONTACT, force=replace(force, as_calibrated=False)))
    VALIDATOR.validate(drifted)
    assert drifted["force"]["as_calibrated"] is False
    read = [Result.from_message(one).force for one in (message, drifted)]
    assert [one.as_calibrated for one in read if one] == [True, False]
    endless = replace(force, value=(0.0, math.inf, 1.0))
    with pytest.raises(ValueError, match=r"force\.value"):
        build_message(TICK, Results(PROCESSED, CONTACT, force=endless))


def test_separate_contacts_are_listed_and_nothing_is_an_empty_list() -> None:
    parts = (CONTACT, replace(CONTACT, area=5.0))
    message = build_message(TICK, Results(PROCESSED, replace(CONTACT, area=9000.0, separate=parts)))
    VALIDATOR.validate(message)
    assert message["contact"]["area"] == 9000.0
    assert [part["area"] for part in message["contacts"]] == [5123.5, 5.0]
    assert build_message(TICK, Results())["contacts"] == []


def test_without_a_processed_image_the_size_is_that_of_the_raw_one_and_reasons_are_passed_on() -> None:
    tick = Tick(TICK.frame, skipped={"contact": "no_contact", "flow": "no_contact"})
    message = build_message(tick, Results())
    assert message["size"] == [800, 600]
    assert message["skipped"] == {"contact": "no_contact", "flow": "no_contact"}
    VALIDATOR.validate(message)


def test_views_that_are_not_contiguous_and_other_number_types_are_written_correctly() -> None:
    wide = np.arange(12, dtype=np.float64).reshape(3, 4)
    markers = Markers(wide[:, ::2], wide[:, 1::2], np.array([0, 9, 0, 9, 0], np.uint8)[::2], wide[:, 0])
    contact = replace(CONTACT, area=np.float64(2.5), center=(np.float32(1.5), 2))
    message = build_message(TICK, Results(None, contact, Flow((0.5, 0.5), np.int64(3)), markers), detail=True)
    assert message["markers"]["origin"] == [[0.0, 2.0], [4.0, 6.0], [8.0, 10.0]]
    assert message["markers"]["position"] == [[1.0, 3.0], [5.0, 7.0], [9.0, 11.0]]
    assert message["contact"]["center"] == [1.5, 2.0]
    VALIDATOR.validate(message)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    "field",
    ["t", "contact.area", "contact.center", "contact.angle", "contact.slope", "contact.hull",
     "contact.ellipse.axes", "flow.mean", "flow.rotation", "markers.origin", "markers.stderr"],
)  # fmt: skip
def test_a_number_that_is_not_finite_is_refused_by_name(field: str, bad: float) -> None:
    tick, contact, flow, markers = TICK, CONTACT, FLOW, MARKERS
    first, _, rest = field.partition(".")
    points = np.array([[1.0, bad]])
    if first == "t":
        tick = Tick(replace(TICK.frame, t=bad))
    elif field == "contact.ellipse.axes":
        contact = replace(CONTACT, ellipse=Ellipse((0, 0), (bad, 1), None))
    elif first == "contact":
        value: Any = {"center": (1.0, bad), "hull": points}.get(rest, bad)
        contact = replace(CONTACT, **{rest: value})
    elif first == "flow":
        flow = replace(FLOW, **{rest: (bad, 1.0) if rest == "mean" else bad})
    else:
        # NaN stands for an unknown standard error.
        bad_errors = np.array([math.inf, 0.0, bad])
        markers = replace(MARKERS, **{rest: bad_errors if rest == "stderr" else points})
    with pytest.raises(ValueError, match=field):
        encode_message(result_of(tick, Results(None, contact, flow, markers)), detail=True)


def _changed(path: str, value: Any) -> dict[str, Any]:
    message = build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS))
    *parents, last = path.split(".")
    target = message
    for name in parents:
        target = target[name]
    if value is ...:
        del target[last]
    else:
        target[last] = value
    return message


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("schema", "tactflow.frame/2"),
        ("seq", -1),
        ("t", None),
        ("size", [0, 400]),
        ("contact", ...),
        ("contact.angle", -90.0),
        ("contact.hull", [[1.0, 2.0, 3.0]]),
        ("contact.ellipse.axes", [1.0, 0.0]),
        ("contact.extra", 1),
        ("flow.mean", [1.0, None]),
        ("markers.status", ["seen"]),
        ("skipped", {"flow": 1}),
    ],
)
def test_the_schema_refuses_what_the_contract_does_not_say(path: str, value: Any) -> None:
    VALIDATOR.validate(build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS)))
    with pytest.raises(jsonschema.ValidationError):
        VALIDATOR.validate(_changed(path, value))


def test_the_schema_is_itself_a_valid_schema_without_defaults() -> None:
    schema = message_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    assert '"default"' not in json.dumps(schema)


def test_a_calibrated_message_has_millimetres_and_with_detail_their_errors() -> None:
    scale = Scale(0.1, 0.2, (0.001, 0.004), (50.0, 100.0))
    depth = Depth(np.zeros((400, 300), np.float32), 0.75, 0.03, 4.5, None)
    results = Results(PROCESSED, CONTACT, FLOW, MARKERS, scale, depth)
    plain = build_message(TICK, results)
    VALIDATOR.validate(plain)
    assert plain["contact"]["center_mm"] == pytest.approx([10.02, 20.34])
    assert plain["contact"]["area_mm2"] == pytest.approx(5123.5 * 0.02)
    assert plain["contact"]["depth_mm"] == 0.75
    assert plain["contact"]["volume_mm3"] == 4.5
    assert plain["flow"]["mean_mm"] == pytest.approx([0.121, -0.066])
    place = np.array(plain["contact"]["center"]) - plain["scale"]["origin"]
    assert place * plain["scale"]["mm_per_px"] == pytest.approx(plain["contact"]["center_mm"])
    assert "center_mm_stderr" not in plain["contact"]
    detailed = build_message(TICK, results, detail=True)
    VALIDATOR.validate(detailed)
    assert detailed["contact"]["center_mm_stderr"] == pytest.approx([0.1002, 0.4068])
    assert detailed["contact"]["depth_mm_stderr"] == 0.03
    assert detailed["contact"]["volume_mm3_stderr"] is None
    assert detailed["flow"]["mean_mm_stderr"] == pytest.approx(
        [math.hypot(1.21 * 0.001, 0.1 * 0.1), math.hypot(0.33 * 0.004, 0.2 * 0.2)]
    )


def test_the_area_of_the_core_is_sent_where_it_is_known() -> None:
    known = replace(CONTACT, core_area=4000.0)
    results = Results(PROCESSED, known, scale=Scale(0.1, 0.2, (0.0, 0.0), (0.0, 0.0)))
    message = build_message(TICK, results)
    VALIDATOR.validate(message)
    assert (message["contact"]["core_area"], message["contact"]["core_area_mm2"]) == (4000, 80)
    unknown = build_message(TICK, results._replace(contact=CONTACT))
    VALIDATOR.validate(unknown)
    assert {"core_area", "core_area_mm2"}.isdisjoint(unknown["contact"])


def test_a_message_is_read_back_as_the_result_it_was_made_of() -> None:
    depth = Depth(np.zeros((400, 300), np.float32), 0.75, 0.03, 4.5, None)
    results = Results(
        PROCESSED,
        replace(CONTACT, core_area=4000.0, separate=(CONTACT, replace(CONTACT, ellipse=None))),
        *(FLOW, MARKERS, Scale(0.1, 0.2, (0.0, 0.0), (5.0, 9.0)), depth),
        force=FORCE,
    )
    sent = result_of(Tick(TICK.frame, skipped={"flow": "unchanged"}), results)
    body = encode_message(sent, detail=True)
    assert b"\n" not in body
    # Read with the standard library: another parser than the encoder's own.
    assert json.loads(body)["markers"]["origin"] == MARKERS.origin.tolist()
    read = Result.from_message(body)
    assert (read.sensor, read.seq, read.t, read.size) == ("main", 36, 1.2, (300, 400))
    assert read.contact is not None
    np.testing.assert_equal(asdict(read.contact), asdict(sent.contact))
    np.testing.assert_equal(asdict(read.markers), asdict(sent.markers))
    assert (read.flow, read.force, read.skipped) == (sent.flow, sent.force, sent.skipped)
    assert read.depth is not None
    assert (read.depth.greatest, read.depth.volume, read.depth.volume_stderr) == (0.75, 4.5, None)


def test_a_new_output_of_a_stage_is_sent_and_read_by_one_line_of_the_description(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class More(fields_module.Message):
        brightness: fields_module.Finite | None = fields_module.sent("mean of the image", "grey levels")

    for module in (encoding, result_module):
        monkeypatch.setattr(module, "Message", More)
    assert "brightness" in Result.port_types()
    message = Result(TICK.frame, {"brightness": 31.5}).to_dict()
    assert message["brightness"] == 31.5
    assert Result.from_message(message)["brightness"] == 31.5
    assert Result(TICK.frame, {}).to_dict()["brightness"] is None
    assert More.model_json_schema()["properties"]["brightness"]["unit"] == "grey levels"


def test_the_tables_of_the_page_are_those_of_the_description() -> None:
    page = (REPOSITORY / "docs" / "results.md").read_text(encoding="utf-8")
    updated = runpy.run_path(str(REPOSITORY / "docs" / "fields.py"))["updated"]
    assert updated(page) == page, "run `python docs/fields.py`"


def test_keys_of_a_later_version_are_ignored_and_an_error_names_the_place() -> None:
    message = build_message(TICK, Results(PROCESSED, CONTACT, FLOW, MARKERS))
    message["contact"]["colour"] = "red"
    assert Result.from_message(message).contact is not None
    message["contact"]["ellipse"]["axes"] = [3.0]
    with pytest.raises(ValueError, match=r"frame/1: contact\.ellipse\.axes\.1: Field required"):
        Result.from_message(message)


@pytest.mark.parametrize("change", [{"size": [math.inf, 1]}, {"seq": "1"}, {"skipped": []}, {"contact": {}}])
def test_what_is_no_message_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"required a message tactflow\.frame/1"):
        Result.from_message(build_message(TICK, Results(PROCESSED)) | change)


def test_markers_that_repeat_are_encoded_as_they_are() -> None:
    """Their text is kept for the next frame; that of others is not taken for it."""
    moved = replace(MARKERS, position=MARKERS.position + 1.0)
    for markers in (MARKERS, MARKERS, moved, MARKERS, replace(moved, status=MARKERS.status[::-1])):
        message = build_message(TICK, Results(PROCESSED, None, None, markers))
        assert message["markers"]["position"] == markers.position.tolist()
        assert message["markers"]["status"] == [STATUS_NAMES[value] for value in markers.status]
