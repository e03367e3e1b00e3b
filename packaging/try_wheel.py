"""Install the wheel of tactflow into an empty environment of each Python, and run the README's first screen.

    make packages
    python packaging/try_wheel.py dist/tactflow-0.1.0-cp311-abi3-linux_x86_64.whl python3.11 python3.13

Prints a Markdown table: megabytes of all files that pip downloads, megabytes in the environment without pip,
seconds to compile what the first run needs. Exits with 1 if a step fails for one of the Pythons.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

README: Final = Path(__file__).resolve().parents[1] / "README.md"
SHORT: Final = "frames=120"
"""Instead of the minute that the README asks for."""
PATIENCE_S: Final = 1800
"""Seconds until a step is given up: an index may be slow."""


def first_screen(readme: str) -> tuple[list[str], str]:
    """Commands and program of the README's first screen, behind the installation.

    Returns
    -------
    commands : lines for a shell, in order, without comments.
    program : Python source.
    """
    shell = re.findall(r"```sh\n(pip install \..*?)```", readme, re.DOTALL)[0]
    program = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)[0]
    lines = [line.split("#")[0].strip() for line in shell.splitlines()]
    return [re.sub(r"frames=\d+", SHORT, line) for line in lines if line.startswith("tactflow ")], program


def run(command: list[str] | str, folder: Path, programs: Path | None = None) -> None:
    """Run one step; raises CalledProcessError with its output if it fails.

    command : a list, or a line for the shell. programs : folder that is searched first for commands.
    """
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    if programs is not None:
        environment["PATH"] = f"{programs}{os.pathsep}{environment['PATH']}"
    subprocess.run(
        command,
        cwd=folder,
        env=environment,
        shell=isinstance(command, str),
        check=True,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


def megabytes(files: Iterator[Path]) -> float:
    """Sum of the sizes, 1e6 bytes."""
    return sum(file.stat().st_size for file in files if file.is_file() and not file.is_symlink()) / 1e6


def attempt(wheel: Path, python: str, folder: Path) -> tuple[float, float, float]:
    """Install and run for one Python.

    Returns
    -------
    download, installed : MB. start : s, of the first command.
    """
    run([python, "-m", "venv", "venv"], folder)
    pip = [str(folder / "venv/bin/python"), "-m", "pip", "--disable-pip-version-check", "--no-cache-dir"]
    bare = megabytes((folder / "venv").rglob("*"))
    run([*pip, "download", "--quiet", "--only-binary", ":all:", "--dest", "files", str(wheel)], folder)
    run(
        [*pip, "install", "--quiet", "--no-compile", "--no-index", "--find-links", "files", "tactflow"],
        folder,
    )
    sizes = megabytes((folder / "files").iterdir()), megabytes((folder / "venv").rglob("*")) - bare
    programs = folder / "venv/bin"
    started = time.monotonic()
    run("tactflow warmup", folder, programs)
    start = time.monotonic() - started
    commands, program = first_screen(README.read_text(encoding="utf-8"))
    (folder / "results.py").write_text(program, encoding="utf-8")
    for command in (*commands, "python results.py"):
        run(command, folder, programs)
    return *sizes, start


def main() -> int:
    """Try each Python; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("wheel", type=Path)
    parser.add_argument("python", nargs="+", help="interpreters, by name or path")
    args = parser.parse_args()
    failed = False
    print(
        "| Python | download, MB | installed, MB | first start, s |\n| --- | --- | --- | --- |",
        flush=True,
    )
    for python in args.python:
        version = subprocess.check_output([python, "-c", "import platform; print(platform.python_version())"])
        with tempfile.TemporaryDirectory() as folder:
            try:
                download, installed, start = attempt(args.wheel.resolve(), python, Path(folder))
            except subprocess.CalledProcessError as error:
                failed = True
                print(f"{python}: {error.cmd} failed\n{error.stdout}{error.stderr}", file=sys.stderr)
                continue
        row = f"| {version.decode().strip()} | {download:.0f} | {installed:.0f} | {start:.0f} |"
        print(row, flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
