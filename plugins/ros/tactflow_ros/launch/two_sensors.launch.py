"""Two sensors in the fingers of a gripper: ros2 launch tactflow_ros two_sensors.launch.py rviz:=true

For the sensors `left` and `right` of one run. The static transforms are those of two gels that face each
other across 40 mm; with transforms:=false they are left to the description of your robot.
"""

from __future__ import annotations

import math

from launch import LaunchDescription, LaunchDescriptionEntity
from launch.actions import DeclareLaunchArgument, GroupAction, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

FINGERS = {"left": (-0.02, math.pi / 2), "right": (0.02, -math.pi / 2)}
"""Sensor -> x of its gel in the frame of the gripper, m, and its turn about y, radians."""
ARGUMENTS = {
    "parent": ("gripper", "frame of the gripper: x from the left to the right finger"),
    "transforms": ("true", "whether to publish where the sensors are"),
    "rviz": ("false", "whether to show both in RViz"),
    "endpoint": ("", "address of tactflow's results"),
    "control": ("", "address for tactflow's commands"),
    "keys": ("", "folder of the subscriber, from tactflow keys new"),
}
"""Argument -> default, description. The last three are passed on to both bridges."""


def finger(sensor: str) -> list[LaunchDescriptionEntity]:
    """The bridge of a sensor, and where the sensor is."""
    x, pitch = FINGERS[sensor]
    frame = f"{sensor}_optical_frame"
    bridge = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(share("launch", "tactflow.launch.py")),
        launch_arguments={
            "sensor": sensor,
            "frame_id": frame,
            "object_frame_id": f"{sensor}_object",
            **{name: LaunchConfiguration(name) for name in ("endpoint", "control", "keys")},
        }.items(),
    )
    place = Node(
        package="tf2_ros",
        executable="static_transform_publisher",
        name=f"{sensor}_finger",
        arguments=[
            *("--x", str(x), "--pitch", str(pitch)),
            *("--frame-id", LaunchConfiguration("parent"), "--child-frame-id", frame),
        ],
        condition=IfCondition(LaunchConfiguration("transforms")),
    )
    # In a group, so that the arguments of one bridge are not those of the other.
    return [GroupAction([bridge]), place]


def share(*parts: str) -> PathJoinSubstitution:
    """A file of this package."""
    return PathJoinSubstitution([FindPackageShare("tactflow_ros"), *parts])


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, both fingers and RViz."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (default, meaning) in ARGUMENTS.items()
    ]
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", share("config", "two_sensors.rviz"), "-f", LaunchConfiguration("parent")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*declared, *finger("left"), *finger("right"), rviz])
