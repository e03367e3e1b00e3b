"""The files of the ROS 2 package fit each other."""

from __future__ import annotations

import ast
import subprocess
import sys
from typing import Any, cast
from xml.etree import ElementTree

import yaml

from plugins.ros.tests.programs import PACKAGE, PYTHON, environment, needs_rclpy


def sources() -> list[str]:
    """Every line of the package."""
    return [line.strip() for file in PACKAGE.glob("*/*.py") for line in file.read_text().splitlines()]


def assigned(name: str) -> ast.expr:
    """The value of a constant of the bridge, without the rclpy that its module imports."""
    for statement in ast.parse((PACKAGE / "tactflow_ros" / "bridge.py").read_text()).body:
        if isinstance(statement, ast.AnnAssign) and ast.unparse(statement.target) == name:
            assert statement.value is not None
            return statement.value
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == name:
            return statement.value
    raise AssertionError(f"the bridge has no {name}")


def parameters() -> dict[str, tuple[Any, str]]:
    """`PARAMETERS` of the bridge."""
    return cast(dict[str, tuple[Any, str]], ast.literal_eval(assigned("PARAMETERS")))


def declared(name: str) -> dict[str, str]:
    """Topic -> name of its type."""
    value = assigned(name)
    assert isinstance(value, ast.Dict)
    keys = [ast.literal_eval(key) for key in value.keys if key is not None]
    return dict(zip(keys, map(ast.unparse, value.values), strict=True))


def test_the_package_names_what_is_there_and_all_that_it_needs() -> None:
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert package.findtext("name") == "tactflow_ros"
    assert package.findtext("export/build_type") == "ament_python"
    setup = (PACKAGE / "setup.py").read_text()
    assert f'version="{package.findtext("version")}"' in setup
    files = [
        f"{folder}/{file.name}" for folder in ("config", "launch") for file in PACKAGE.glob(f"{folder}/*.*")
    ]
    assert len(files) == 4
    for file in (*files, "package.xml"):
        assert file in setup
        assert (PACKAGE / file).exists()
    assert (PACKAGE / "resource" / "tactflow_ros").exists()
    imported = {line.split()[1].split(".")[0] for line in sources() if line.startswith(("from ", "import "))}
    depends = {node.text for node in package.findall("exec_depend")}
    comes_with_rclpy = {"rcl_interfaces", "builtin_interfaces"}
    foreign = {name for name in imported if name.endswith(("_msgs", "_srvs", "_interfaces", "rclpy"))}
    assert foreign - comes_with_rclpy <= depends
    assert "tactflow" not in imported


def test_the_file_of_parameters_has_every_parameter_with_its_default() -> None:
    (node,) = yaml.safe_load((PACKAGE / "config" / "tactflow.yaml").read_text()).values()
    assert node["ros__parameters"] == {name: default for name, (default, _) in parameters().items()}


@needs_rclpy
def test_a_parameter_of_the_wrong_type_is_told_without_a_traceback() -> None:
    command = [str(PYTHON), "-m", "tactflow_ros", "--ros-args", "-p", "timeout:=2"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "'timeout' to '2' of type 'INTEGER', expecting type 'DOUBLE'" in done.stderr
    assert "Traceback" not in done.stderr


def test_without_ros_the_program_says_what_is_missing() -> None:
    # The environment of these tests has no rclpy.
    command = [sys.executable, "-m", "tactflow_ros"]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "rclpy is missing" in done.stderr
    assert "source /opt/ros" in done.stderr
