"""Bridge of a sensor: ros2 launch tactflow_ros tactflow.launch.py sensor:=left control:=tcp://..."""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "endpoint": "address of tactflow's results",
    "control": "address for tactflow's commands",
    "keys": "folder of the subscriber, from tactflow keys new",
    "frame_id": "frame of the picture",
    "reliability": "best_effort or reliable",
}
"""Argument -> description; the parameter file has the defaults."""


def start(context: LaunchContext) -> list[LifecycleNode]:
    """Create the node with the parameters of the file, overridden by the arguments."""

    def argument(name: str) -> str:
        return str(LaunchConfiguration(name).perform(context))

    overrides = {name: argument(name) for name in ARGUMENTS if argument(name)}
    flags = {name: argument(name) == "true" for name in ("use_sim_time", "publish_clock") if argument(name)}
    node = LifecycleNode(
        package="tactflow_ros",
        executable="bridge",
        name="tactflow",
        namespace=argument("sensor"),
        parameters=[argument("params"), {"sensor": argument("sensor")}, overrides | flags],
        output="screen",
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and the node."""
    config = PathJoinSubstitution([FindPackageShare("tactflow_ros"), "config", "tactflow.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "sensor", default_value="main", description="name in tactflow, and namespace"
            ),
            DeclareLaunchArgument("params", default_value=config, description="YAML file of parameters"),
            DeclareLaunchArgument("use_sim_time", default_value="", description="true for recordings"),
            DeclareLaunchArgument("publish_clock", default_value="", description="true to publish /clock"),
            *(
                DeclareLaunchArgument(name, default_value="", description=meaning)
                for name, meaning in ARGUMENTS.items()
            ),
            OpaqueFunction(function=start),
        ]
    )
