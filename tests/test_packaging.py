"""What tactflow is published with: metadata of the wheel, containers, the recipe for conda."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib

import pytest
import yaml

from tactflow.cli.main import main
from tests.paths import REPOSITORY

PACKAGING = REPOSITORY / "packaging"
SERVICES = yaml.safe_load((PACKAGING / "compose.yaml").read_text())["services"]


def test_links_of_the_readme_work_on_a_package_index() -> None:
    environment = os.environ | {"GITHUB_REPOSITORY": "someone/tactflow", "GITHUB_REF_NAME": "v0.1.0"}
    command = [sys.executable, "setup.py", "--quiet", "--long-description"]
    shown = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True
    ).stdout
    links = re.findall(r"\]\(([^)\s]+)\)", shown)
    assert "https://github.com/someone/tactflow/raw/v0.1.0/docs/results.jpg" in links
    assert "https://github.com/someone/tactflow/blob/v0.1.0/docs/robots.md#lerobot" in links
    assert [link for link in links if not link.startswith("https://")] == []


@pytest.mark.parametrize("sensor", ["left", "right"])
def test_the_runs_of_the_containers_are_valid(sensor: str) -> None:
    run, _, source, *settings = SERVICES[sensor]["command"]
    page = ["--set=sinks.view={host: 0.0.0.0, token: simulated-sensors}"]
    assert run == "run"
    assert main(["check", f"--set=stages.capture.source={source.partition('=')[2]}", *settings, *page]) == 0


def test_the_image_is_built_from_every_file_that_the_wheel_needs() -> None:
    kept = {
        line[1:] for line in (PACKAGING / "Dockerfile.dockerignore").read_text().split() if line[0] == "!"
    }
    folders = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"]
    linked = {
        str(file.readlink()).removeprefix("../")
        for file in REPOSITORY.glob("pipelines/*")
        if file.is_symlink()
    }
    needed = {folder.partition("/")[0] for folder in folders.values()} | linked
    assert needed | {"setup.py", "README.md", "LICENSE", "packaging/entrypoint"} <= kept
    assert all((REPOSITORY / name).exists() for name in kept)


def test_the_conda_recipe_needs_what_the_wheel_needs() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    recipe = yaml.safe_load((PACKAGING / "conda" / "recipe.yaml").read_text())
    ours = {line.replace(" ", "") for line in recipe["requirements"]["run"] if not line.startswith("python")}
    theirs = {line.replace("opencv-contrib-python-headless", "py-opencv") for line in project["dependencies"]}
    assert ours == theirs
    assert recipe["context"]["version"] == project["version"]


def locked(environment: str) -> list[str]:
    command = [sys.executable, str(PACKAGING / "lock.py"), "show", environment]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    return re.findall(r"^\S+==\S+(?: ;.*?)?(?= \\$)", shown, re.MULTILINE)


def test_the_lock_file_has_every_package_that_an_environment_needs() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    for environment, requirements in {"run": extras["all"], "test": extras["test"]}.items():
        pinned = {line.partition("==")[0].lower() for line in locked(environment)}
        pending, needed = [*project["dependencies"], *requirements], set()
        while pending:
            name, _, more = re.split(r"([\[<>=!~;]|$)", pending.pop().replace(" ", ""), maxsplit=1)
            if name == "tactflow":
                pending += [line for extra in more.rstrip("]").split(",") for line in extras[extra]]
            else:
                needed.add(name.lower())
        assert needed <= pinned, environment


@pytest.mark.parametrize("environment", ["run", "test", "docs", "ros", "lerobot"])
def test_an_environment_holds_one_version_of_each_package(environment: str) -> None:
    pins = locked(environment)
    unconditional = [line.partition("==")[0] for line in pins if ";" not in line]
    assert len(unconditional) > 20
    assert len(set(unconditional)) == len(unconditional)


def test_beside_lerobot_both_packages_of_opencv_have_the_same_version() -> None:
    versions = {line.partition("==")[2] for line in locked("lerobot") if line.startswith("opencv-")}
    assert len(versions) == 1
