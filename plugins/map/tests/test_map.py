"""`tactflow map`: surfaces from contacts, against objects whose shape is known."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.plugins.map.closure import mapped, registered, weakened
from tactflow.plugins.map.graph import optimised, spanning, twist
from tactflow.plugins.map.joining import joined
from tactflow.plugins.map.keyframes import Contact, Edge, Touch, contacts_of, keyframe_of
from tactflow.plugins.map.page import unseen
from tactflow.plugins.map.ply import read_ply
from tactflow.plugins.map.surface import Points, merged
from tactflow.vision.arrays import Floats, Floats32
from tactflow.vision.pose.rigid import inverse, rigid
from tactflow.vision.types import Contact as FoundContact
from tactflow.vision.types import Depth, Scale
from tests.terminal import Terminal

SCALE = Scale(0.05, 0.05, (0.0, 0.0), (99.5, 99.5))
Y, X = (np.mgrid[:200, :200] - 99.5) * 0.05
MASK = np.where(np.hypot(X, Y) < 3, 255, 0).astype(np.uint8)
STEP_MM = 0.25
"""How far the plate moves from frame to frame."""
SQUARE = [(1, 0)] * 16 + [(0, 1)] * 16 + [(-1, 0)] * 16 + [(0, -1)] * 16
"""Directions of the steps of a plate that ends where it began."""


def relief(x: Floats, y: Floats) -> Floats:
    """Height of a plate towards the gel, mm, at places on it, mm."""
    return 0.3 + 0.04 * (np.sin(2 * x + y) + np.sin(0.7 * x - 2.3 * y + 1) + np.sin(1.3 * x * np.cos(y / 5)))


def touch(seq: int, moved: Floats, stderr: float = 0.003) -> Touch:
    """The contact with a plate that has moved by (x, y), mm, under a gel that bulges in the middle."""
    heights: Floats32 = relief(X - moved[0], Y - moved[1]).astype(np.float32)
    return Touch(seq, SCALE, Depth(heights, 0.4, stderr, 1.0, None), MASK)


def square() -> Iterator[Touch]:
    """A plate that slides along a square."""
    for seq, place in enumerate(STEP_MM * np.cumsum([(0, 0), *SQUARE], axis=0)):
        yield touch(seq, place)


@pytest.fixture(scope="module")
def plate() -> Contact:
    """The contact with a plate that slides along a square."""
    (contact,) = contacts_of(square())
    return contact


def errors(points: Points, contact: Contact, anchor: int) -> Floats:
    """(N,), mm: height of points over the plate."""
    place = STEP_MM * np.cumsum([(0, 0), *SQUARE], axis=0)[contact.keyframes[anchor].seq]
    x, y, z = points.place.T
    return -z - relief(x - place[0], y - place[1])


def test_a_plate_larger_than_the_contact_becomes_one_surface(plate: Contact) -> None:
    graph = mapped(plate.keyframes, plate.edges)
    points = merged(plate.keyframes, graph)
    assert 8 < len(plate.keyframes) < len(SQUARE)
    assert np.ptp(points.place, axis=0)[:2] == pytest.approx([9, 9], abs=0.8)
    off = np.abs(errors(points, plate, graph.anchor))
    assert np.median(off) < 0.003
    assert np.mean(off < 2 * points.error) > 0.9
    np.testing.assert_allclose(np.linalg.norm(points.normal, axis=1), 1)
    assert (points.normal[:, 2] < 0).all()
    # One layer: few points have another one much nearer than a cell of 0.15 mm.
    away = np.linalg.norm(points.place[:, None, :] - points.place[None, ::40], axis=2)
    assert np.median(np.sort(away, axis=0)[1]) > 0.1


def test_a_place_that_is_touched_again_closes_a_loop(plate: Contact) -> None:
    plain = mapped(plate.keyframes, plate.edges, loops=False)
    graph = mapped(plate.keyframes, plate.edges)
    loops = graph.edges[len(plate.edges) :]
    last = len(plate.keyframes) - 1
    assert plain.edges == plate.edges
    assert any(loop.before < 3 and loop.now > last - 3 for loop in loops)
    ends = [
        np.trace(one.motion(0, last, one.covariance(0, last)).covariance[:3, :3]) for one in (plain, graph)
    ]
    assert ends[1] < ends[0] / 2


def test_loops_of_the_same_patch_count_as_one() -> None:
    loops = [Edge(*pair, np.eye(4), np.eye(6), np.zeros(6)) for pair in ((0, 7), (0, 8), (3, 9))]
    assert [loop.covariance[0, 0] for loop in weakened(loops)] == [2, 2, 1]


def turned(number: int, degrees: float, way: Floats) -> Iterator[Touch]:
    """The plate, put down again after a turn, that moves along a way (N, 2), mm."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    for seq, place in enumerate(way):
        x, y = X - place[0], Y - place[1]
        heights = relief(cos * x + sin * y, cos * y - sin * x).astype(np.float32)
        yield Touch(100 * number + seq, SCALE, Depth(heights, 0.4, 0.003, 1.0, None), MASK)


def test_contacts_that_show_the_same_part_after_a_turn_are_joined() -> None:
    way = STEP_MM * np.column_stack([np.arange(12), np.zeros(12)])
    (one,), (other,) = (contacts_of(turned(n, degrees, way)) for n, degrees in ((0, 0.0), (1, 110.0)))
    contact, count = joined([other, one])
    assert count == 2
    assert contact.frames == 24
    graph = mapped(contact.keyframes, contact.edges)
    motion = graph.motion(0, len(one.keyframes), graph.covariance(0, len(one.keyframes))).motion
    assert abs(np.degrees(np.arctan2(motion[1, 0], motion[0, 0]))) == pytest.approx(110, abs=0.5)
    np.testing.assert_allclose(motion[:3, 3], 0, atol=0.05)


def test_contacts_that_show_nothing_in_common_are_not_joined() -> None:
    near, far = (np.array([[x, 0.0], [x + 0.25, 0.0]]) for x in (0.0, 31.0))
    (one,), (other,) = (contacts_of(turned(n, 0.0, way)) for n, way in enumerate((near, far)))
    contact, count = joined([one, other])
    assert (count, contact) == (1, one)


def test_smooth_domes_are_not_joined_wherever_they_fit() -> None:
    heights = np.maximum(0.5 - 0.05 * (X**2 + Y**2), 0).astype(np.float32)
    mask = np.where(heights > 0, 255, 0).astype(np.uint8)
    dome = Touch(0, SCALE, Depth(heights, 0.5, 0.01, 1.0, None), mask)
    assert joined([*contacts_of([dome]), *contacts_of([dome])])[1] == 1


def test_another_plate_at_the_predicted_place_closes_no_loop(plate: Contact) -> None:
    *keyframes, _ = plate.keyframes
    (other,) = contacts_of([touch(99, np.array([31.0, 17.0]))])
    graph = mapped([*keyframes, *other.keyframes], plate.edges)
    assert not [edge for edge in graph.edges[len(plate.edges) :] if edge.now == len(keyframes)]


def test_a_smooth_dome_says_that_its_turns_are_not_seen(plate: Contact) -> None:
    frames = []
    for seq, left in enumerate((-0.5, 0.5)):
        heights = np.maximum(0.5 - 0.05 * ((X - left) ** 2 + Y**2), 0).astype(np.float32)
        mask = np.where(heights > 0, 255, 0).astype(np.uint8)
        frames.append(keyframe_of(Touch(seq, SCALE, Depth(heights, 0.5, 0.01, 1.0, None), mask)))
    registration = registered(frames, 0, 1, np.eye(4))  # type: ignore[arg-type]
    assert registration is not None
    edge = registration[1]
    assert edge.motion[0, 3] == pytest.approx(1, abs=0.05)
    dome = Contact(frames, [edge])  # type: ignore[arg-type]
    said = " ".join(unseen(dome, optimised(spanning([edge], 0), [edge], 0, 0.02)))
    assert "Turns are not well seen: in frame 1" in said
    assert not list(unseen(plate, mapped(plate.keyframes, plate.edges)))


def test_a_contact_ends_where_the_object_is_lifted() -> None:
    frames = [None, *(touch(seq, np.zeros(2)) for seq in (1, 2)), None, touch(4, np.zeros(2))]
    assert [(one.keyframes[0].seq, one.frames) for one in contacts_of(frames)] == [(1, 2), (4, 1)]


def rolled(slope_error: float) -> list[Edge]:
    """A ball of 3 mm that rolls around once in 24 steps, with all tilts too small."""
    covariance = np.diag([0.01, 0.01, 0.01, 0.003, 0.003, 0.003]) ** 2
    angle = 2 * np.pi / 24
    parts = np.array([0, 0, 0, 0, angle / (1 + slope_error), 0])
    edges = []
    for step in range(24):
        center = np.eye(4)
        center[:3, 3] = step * 3 * angle, 0, 3
        forward = np.eye(4)
        forward[0, 3] = 3 * angle
        motion = forward @ center @ rigid(parts) @ inverse(center)
        by = twist(center @ rigid(parts * 1e-4) @ inverse(center)) * 1e4
        edges.append(Edge(step, step + 1, motion, covariance, by))
    return edges


def test_a_closed_loop_shows_how_wrong_all_slopes_are() -> None:
    edges = rolled(0.05)
    forward = np.eye(4)
    forward[0, 3] = 6 * np.pi
    loop = Edge(0, 24, forward, edges[0].covariance, np.zeros(6))
    before = optimised(spanning(edges, 0), edges, 0, 0.1)
    after = optimised(before.poses, [*edges, loop], 0, 0.1)
    assert before.slope_error == pytest.approx(0)
    assert before.contradiction(loop, before.covariance(0, 24)) < 6
    assert after.slope_error == pytest.approx(0.05, abs=0.006)
    assert after.covariance()[0, 0] ** 0.5 < 0.01
    half = after.poses[12][:3, :3]
    assert np.arccos((np.trace(half) - 1) / 2) == pytest.approx(np.pi, abs=0.05)


def test_the_pose_of_the_anchor_is_known_and_far_ones_are_less_so() -> None:
    edges = rolled(0.0)
    graph = optimised(spanning(edges, 7), edges, 7, 0.1)
    assert graph.covariance(7).shape == (7, 7)
    assert not graph.covariance(7)[:6].any()
    both = graph.covariance(3, 20)
    np.testing.assert_allclose(both, both.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(both[6:, 6:], graph.covariance(20))
    assert both[6 + 4, 6 + 4] > both[4, 4] > 0
    assert both[-1, -1] == pytest.approx(0.1**2)


def test_turns_about_a_fixed_axis_are_multiples_of_one_twist() -> None:
    axis = rigid(np.array([5.0, 1.0, -2.0, 0, 0, 0]))
    small, large = (axis @ rigid(k * np.array([0, 0, 0, 0, 0.2, 0.1])) @ inverse(axis) for k in (1e-3, 9))
    np.testing.assert_allclose(twist(large), 9e3 * twist(small), rtol=1e-6, atol=1e-8)


def results(frames: list[Touch | None]) -> Iterator[Result]:
    """What a pipeline would give."""
    found = FoundContact(100.0, (99.5, 99.5), None, None, np.zeros((3, 2)), None)
    for seq, one in enumerate(frames):
        frame = Frame("main", seq, seq / 30, np.zeros((200, 200, 3), np.uint8))
        values = {"contact": found, "contact_mask": MASK, "scale": SCALE}
        yield Result(frame, {} if one is None else {**values, "depth": one.depth})


@pytest.fixture
def streamed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pipeline that finds the plate."""
    far = touch(99, np.array([31.0, 17.0]))
    monkeypatch.setattr("tactflow.streaming.stream", lambda _: results([None, *square(), None, far]))


@pytest.mark.usefixtures("streamed")
def test_the_command_writes_points_and_a_page(terminal: Terminal) -> None:
    pytest.importorskip("matplotlib", reason="the extra plot is not installed")
    assert terminal("map", "sim:press", "--out", "plate.ply") == 0, terminal.err
    assert "frames: standard error" in terminal.err
    assert "1 of 2 contacts; the others do not show where they belong." in terminal.err
    table = read_ply(Path("plate.ply"))
    assert table.dtype.names[:3] == ("x", "y", "z")
    assert len(table) > 1000
    assert np.median(table["error"]) < 0.02
    assert len(np.unique(table["red"])) > 10
    page = Path("plate.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2
    assert "loops closed" in page
    data = re.search(r'atob\("([^"]+)"\)', page)
    assert data is not None
    assert len(base64.b64decode(data[1])) == 12 * len(table)
    assert terminal("map", "sim:press", "--out", "plate.ply") == 2
    assert "--overwrite" in terminal.err
    assert terminal("map", "sim:press", "--contact", "3", "--out", "other.ply") == 2
    assert "--contact: required 1 to 2, got 3" in terminal.err
    assert terminal("map", "sim:press", "--contact", "2", "--out", "other.ply") == 0
    assert len(read_ply(Path("other.ply"))) < len(table)


@pytest.mark.parametrize(
    ("pipeline", "override", "has_slip"),
    [("default", [], True), ("default", ["stages.slip=null"], False), ("markerless", [], False)],
)
def test_slip_is_asked_for_where_dots_show_it(
    pipeline: str, override: list[str], has_slip: bool, terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = []
    monkeypatch.setattr(
        "tactflow.streaming.stream", lambda pipeline: used.append(pipeline) or results([None])
    )
    sets = [word for text in override for word in ("--set", text)]
    assert terminal("map", "sim:press", "--pipeline", pipeline, *sets) == 3
    assert ("slip" in used[0].nodes) is has_slip


def test_without_a_calibration_it_says_what_to_do(terminal: Terminal) -> None:
    assert terminal("map", "sim:press?frames=40") == 2
    assert "tactflow calibrate" in terminal.err
    assert "--set calibration=FILE" in terminal.err
    assert not Path("map.ply").exists()


def test_without_contact_it_says_so(terminal: Terminal) -> None:
    assert terminal("map", "sim:idle?frames=5") == 3
    assert "no contact is large enough to be mapped" in terminal.err
    assert terminal("map", "sim:idle?frames=5", "--set", "stages.depth=null") == 2
    assert "scale and depth" in terminal.err


def test_a_camera_is_refused(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = SimpleNamespace(live=True, close=lambda: None)
    monkeypatch.setattr("tactflow.sources.open_source", lambda _: camera)
    assert terminal("map", "0") == 2
    assert "required a recording" in terminal.err
