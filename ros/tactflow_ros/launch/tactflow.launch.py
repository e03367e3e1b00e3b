"""One bridge for a sensor: ros2 launch tactflow_ros tactflow.launch.py sensor:=left control:=tcp://..."""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "endpoint": "where tactflow publishes",
    "control": "where tactflow takes commands",
    "keys": "the subscriber's folder of tactflow keys new",
    "frame_id": "frame of the picture",
    "parent_frame": "what it is fixed to",
    "reliability": "best_effort or reliable",
}
"""Argument -> what it means; where it is not given, the file of parameters says it."""


def start(context: LaunchContext) -> list[LifecycleNode]:
    """The node: parameters of the file, and above them what was given."""

    def argument(name: str) -> str:
        return str(LaunchConfiguration(name).perform(context))

    given = {name: argument(name) for name in ARGUMENTS if argument(name)}
    flags = {name: argument(name) == "true" for name in ("use_sim_time", "publish_clock") if argument(name)}
    node = LifecycleNode(
        package="tactflow_ros",
        executable="bridge",
        name="tactflow",
        namespace=argument("sensor"),
        parameters=[argument("params"), {"sensor": argument("sensor")}, given | flags],
        output="screen",
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """The arguments, and the node."""
    config = PathJoinSubstitution([FindPackageShare("tactflow_ros"), "config", "tactflow.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "sensor", default_value="main", description="name in tactflow, and namespace"
            ),
            DeclareLaunchArgument("params", default_value=config, description="YAML file of parameters"),
            DeclareLaunchArgument("use_sim_time", default_value="", description="true: for recordings"),
            DeclareLaunchArgument("publish_clock", default_value="", description="true: send /clock"),
            *(
                DeclareLaunchArgument(name, default_value="", description=meaning)
                for name, meaning in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
