"""One lock file for all environments of this repository: `requirements.lock`.

    python packaging/lock.py install test     # into the environment of this Python, with pip, checking hashes
    python packaging/lock.py show test        # as a requirements file
    python packaging/lock.py make             # resolve anew with uv; --upgrade takes newer versions

The file holds each package once, with the hashes of its files and, in a comment, its environments. The
environments share one version wherever their requirements allow it. LeRobot's has an older OpenCV, which is
why it is not installed into the others.

Only the standard library is needed to install, so that a machine with Python and pip is enough.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

REPOSITORY: Final = Path(__file__).resolve().parents[1]
LOCK: Final = REPOSITORY / "requirements.lock"
HEADER: Final = """\
# Made by `make lock`: the packages of all environments, for Python 3.11 and newer, on every system.
# `python packaging/lock.py show test` prints one environment as a requirements file for pip.
"""
BUILD: Final = "setuptools>=77\n"
"""Builds tactflow itself, which is installed without the isolation that would fetch an unlocked one."""


@dataclass(frozen=True)
class Environment:
    """What an environment is resolved from.

    inputs : files below the repository. extra : of tactflow, where `pyproject.toml` is among them.
    left_out : file with the requirements that are dropped; pip must then not look for missing ones.
    builds : whether tactflow is installed into it.
    """

    inputs: Sequence[str]
    extra: str | None = None
    left_out: str | None = None
    builds: bool = True


ENVIRONMENTS: Final = {
    "test": Environment(["pyproject.toml"], "test"),
    "run": Environment(["pyproject.toml"], "all"),
    "docs": Environment(["pyproject.toml", "docs/site/requirements.in"], "plot"),
    "ros": Environment(["plugins/ros/requirements.in"], builds=False),
    "lerobot": Environment(
        ["plugins/lerobot/camera/requirements.in"], left_out="plugins/lerobot/camera/left_out.txt"
    ),
}
"""In the order in which they are resolved: each prefers the versions of those before it."""

NEVER: Final = "sys_platform == 'never'"
"""Marker of requirements that are left out."""

Locked = dict[str, set[str]]
"""Requirement of one version, with its hashes and without a line end -> its environments."""


def read(text: str) -> Locked:
    """Parse the lock file.

    >>> {block: sorted(names) for block, names in read("rich==15 --hash=x\\n    # run test\\n").items()}
    {'rich==15 --hash=x': ['run', 'test']}
    """
    blocks = re.findall(r"^(\S.*(?:\n    --.*)*)\n    # (.*)$", text, re.MULTILINE)
    return {block: set(names.split()) for block, names in blocks}


def written(locked: Locked) -> str:
    """The text of the lock file."""
    blocks = (f"{block}\n    # {' '.join(sorted(names))}\n" for block, names in sorted(locked.items()))
    return HEADER + "".join(blocks)


def of_environment(locked: Locked, name: str) -> list[str]:
    """The requirements of one environment. Raises SystemExit if it has none."""
    if found := [block for block, names in locked.items() if name in names]:
        return found
    raise SystemExit(f"{LOCK.name} has no environment {name}: make lock")


def package(block: str) -> str:
    """Name of the package of a requirement."""
    return block.partition("==")[0]


def resolve(environment: Environment, preferred: Iterable[str], *, upgrade: bool) -> list[str]:
    """The requirements of an environment, by uv. preferred : versions to take where they are allowed."""
    command = [
        *(sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--universal"),
        *("--python-version", "3.11", "--generate-hashes", "--no-annotate", "--no-header"),
        *(["--upgrade"] if upgrade else []),
        *([] if environment.extra is None else ["--extra", environment.extra]),
        *([] if environment.left_out is None else ["--override", environment.left_out]),
        *(*environment.inputs, "-"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        # uv prefers the versions in the file that it is to write.
        output = Path(folder, "requirements.txt")
        output.write_text("".join(f"{block}\n" for block in preferred))
        subprocess.run(
            [*command, "--output-file", str(output)],
            cwd=REPOSITORY,
            check=True,
            text=True,
            input=BUILD if environment.builds else "",
        )
        blocks = re.findall(r"^\S.*(?:\n    --.*)*", output.read_text(), re.MULTILINE)
    return [block for block in blocks if NEVER not in block]


def make(*, upgrade: bool) -> None:
    """Resolve all environments, and write the lock file."""
    old = read(LOCK.read_text()) if LOCK.exists() else {}
    locked: Locked = {}
    for name, environment in ENVIRONMENTS.items():
        shared = {package(block) for block in locked}
        kept = [b for b, names in old.items() if name in names and package(b) not in shared]
        preferred = [*locked, *([] if upgrade else kept)]
        for block in resolve(environment, preferred, upgrade=upgrade and not locked):
            locked.setdefault(block, set()).add(name)
    LOCK.write_text(written(locked))
    count = len({package(block) for block in locked})
    print(f"{LOCK.name}: {count} packages, {LOCK.stat().st_size / 1e3:.0f} kB")


def install(name: str, again: str | None = None) -> None:
    """Install the packages of an environment into that of this Python.

    again : only this one of them, even if it is there.
    """
    blocks = of_environment(read(LOCK.read_text()), name)
    if again is not None:
        blocks = [block for block in blocks if package(block) == again]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "requirements.txt")
        file.write_text("".join(f"{block}\n" for block in blocks))
        command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]
        command += ["install", "--require-hashes", "--requirement", str(file)]
        # All that is needed is listed, and what was left out shall not come back.
        command += ["--no-deps"] if again is None else ["--no-deps", "--force-reinstall"]
        code = subprocess.run(command, check=False).returncode
    if code:
        raise SystemExit(code)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for command in ("install", "show"):
        commands.add_parser(command).add_argument("environment", choices=ENVIRONMENTS)
    commands.choices["install"].add_argument("--again", metavar="PACKAGE", help="only this one, once more")
    commands.add_parser("make").add_argument("--upgrade", action="store_true")
    args = parser.parse_args()
    if args.command == "make":
        make(upgrade=args.upgrade)
    elif args.command == "install":
        install(args.environment, args.again)
    else:
        print("\n".join(of_environment(read(LOCK.read_text()), args.environment)))


if __name__ == "__main__":
    main()
