"""One bridge for a sensor: ros2 launch tactflow_ros tactflow.launch.py sensor:=left control:=tcp://..."""

from __future__ import annotations

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

ARGUMENTS = {
    "sensor": ("main", "name of the sensor in tactflow; also the namespace of the node"),
    "endpoint": ("tcp://127.0.0.1:5556", "where tactflow publishes"),
    "control": ("", "where tactflow takes commands; empty: nowhere"),
    "frame_id": ("tactile_optical_frame", "frame of the picture"),
    "parent_frame": ("", "what it is fixed to; empty: no transform"),
    "reliability": ("best_effort", "or reliable"),
}
"""Argument -> its default, and what it means."""


def generate_launch_description() -> LaunchDescription:
    """Arguments, and the node with the parameters of config/tactflow.yaml below them."""
    config = PathJoinSubstitution([FindPackageShare("tactflow_ros"), "config", "tactflow.yaml"])
    given = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ARGUMENTS}
    params = LaunchConfiguration("params")
    sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=meaning)
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            DeclareLaunchArgument("params", default_value=config, description="YAML file of parameters"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="for recordings"),
            LifecycleNode(
                package="tactflow_ros",
                executable="bridge",
                name="tactflow",
                namespace=LaunchConfiguration("sensor"),
                parameters=[params, given, {"use_sim_time": sim_time}],
                output="screen",
            ),
        ]
    )
