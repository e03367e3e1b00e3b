"""The launch files and the RViz configuration, against stand-ins for `launch`, which has no wheel."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import ItemsView, Iterator
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import yaml

from plugins.ros.tests.programs import PACKAGE
from plugins.ros.tests.test_package import declared, parameters

MODULES = (
    *("launch", "launch.actions", "launch.conditions", "launch.substitutions"),
    *("launch.launch_description_sources", "launch_ros", "launch_ros.actions", "launch_ros.substitutions"),
)


class Entity:
    """Whatever a launch file makes: it keeps what it was made of."""

    def __init__(self, kind: str, /, *arguments: Any, **options: Any) -> None:
        self.kind, self.arguments, self.options = kind, arguments, options


class StandIn(ModuleType):
    """A module in which every name is a kind of `Entity`."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return partial(Entity, name)


@pytest.fixture(autouse=True)
def _launch(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in MODULES:
        monkeypatch.setitem(sys.modules, name, StandIn(name))


def launch_file(name: str) -> Any:
    spec = importlib.util.spec_from_file_location("launched", PACKAGE / "launch" / f"{name}.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def entities(value: Any, kind: str) -> Iterator[Entity]:
    """All of a kind in a description."""
    if isinstance(value, Entity):
        if value.kind == kind:
            yield value
        value = [*value.arguments, *value.options.values()]
    if isinstance(value, list | tuple | ItemsView):
        for part in value:
            yield from entities(part, kind)


def arguments(description: Entity) -> set[str]:
    """Names of the declared arguments."""
    return {one.arguments[0] for one in entities(description, "DeclareLaunchArgument")}


def test_every_argument_is_a_parameter_of_the_node_with_its_type() -> None:
    file = launch_file("tactflow")
    names = arguments(file.generate_launch_description())
    assert names - {"params", "use_sim_time"} <= parameters().keys()
    given = dict.fromkeys(names, "") | {
        "sensor": "left",
        "params": "a.yaml",
        "surface_step": "3",
        "use_sim_time": "true",
    }
    (node,) = file.start(SimpleNamespace(launch_configurations=given))
    assert (node.options["namespace"], node.options["executable"]) == ("left", "bridge")
    first, *rest = node.options["parameters"]
    assert first == "a.yaml"
    assert rest == [{"sensor": "left"}, {"surface_step": 3, "use_sim_time": True}]


def test_two_sensors_have_frames_of_their_own() -> None:
    description = launch_file("two_sensors").generate_launch_description()
    known = arguments(launch_file("tactflow").generate_launch_description())
    bridges = [
        dict(one.options["launch_arguments"]) for one in entities(description, "IncludeLaunchDescription")
    ]
    assert [one["sensor"] for one in bridges] == ["left", "right"]
    assert all(one.keys() <= known for one in bridges)
    for name in ("frame_id", "object_frame_id"):
        assert len({one[name] for one in bridges}) == 2
    places = [
        one.options["arguments"]
        for one in entities(description, "Node")
        if one.options["executable"] == "static_transform_publisher"
    ]
    assert [one[-1] for one in places] == [one["frame_id"] for one in bridges]
    used = {one.arguments[0] for one in entities(description, "LaunchConfiguration")}
    assert used == arguments(description)


def test_rviz_shows_topics_that_the_bridges_publish_as_they_publish_them() -> None:
    shown = yaml.safe_load((PACKAGE / "config" / "two_sensors.rviz").read_text())["Visualization Manager"]
    topics = declared("UNITLESS")
    kinds = {"PointCloud2": "PointCloud2", "Wrench": "WrenchStamped", "Image": "CompressedImage"}
    displays = [one for one in shown["Displays"] if "Topic" in one]
    assert len(displays) == 6
    for display in displays:
        _, sensor, node, topic = display["Topic"]["Value"].split("/", 3)
        assert (sensor, node) in (("left", "tactflow"), ("right", "tactflow"))
        assert topics[topic] == kinds[display["Class"].removeprefix("rviz_default_plugins/")]
        assert display["Topic"]["Reliability Policy"] == "Best Effort"
    assert shown["Global Options"]["Fixed Frame"] == launch_file("two_sensors").ARGUMENTS["parent"][0]
