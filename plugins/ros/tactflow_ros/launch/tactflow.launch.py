"""Bridge of a sensor: ros2 launch tactflow_ros tactflow.launch.py sensor:=left control:=tcp://..."""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "endpoint": "address of tactflow's results",
    "control": "address for tactflow's commands",
    "keys": "folder of the subscriber, from tactflow keys new",
    "frame_id": "frame of the picture",
    "object_frame_id": "frame of the object on /tf",
    "surface_step": "every how many pixels the topic surface has a point",
    "reliability": "best_effort or reliable",
    "use_sim_time": "true for recordings",
    "publish_clock": "true to publish /clock",
}
"""Argument -> description; the parameter file has the defaults."""


def start(context: LaunchContext) -> list[LifecycleNode]:
    """Create the node with the parameters of the file, overridden by the arguments."""
    arguments = context.launch_configurations
    overrides: dict[str, str | bool | int] = {name: arguments[name] for name in ARGUMENTS if arguments[name]}
    for name in ("use_sim_time", "publish_clock"):
        if name in overrides:
            overrides[name] = overrides[name] == "true"
    if "surface_step" in overrides:
        overrides["surface_step"] = int(overrides["surface_step"])
    sensor = arguments["sensor"]
    node = LifecycleNode(
        package="tactflow_ros",
        executable="bridge",
        name="tactflow",
        namespace=sensor,
        parameters=[arguments["params"], {"sensor": sensor}, overrides],
        output="screen",
    )
    return [node]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and the node."""
    config = PathJoinSubstitution([FindPackageShare("tactflow_ros"), "config", "tactflow.yaml"])
    optional = [
        DeclareLaunchArgument(name, default_value="", description=ARGUMENTS[name]) for name in ARGUMENTS
    ]
    sensor = DeclareLaunchArgument("sensor", default_value="main", description="in tactflow, and namespace")
    params = DeclareLaunchArgument("params", default_value=config, description="YAML file of parameters")
    return LaunchDescription([sensor, params, *optional, OpaqueFunction(function=start)])
