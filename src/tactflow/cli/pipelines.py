"""`tactflow pipelines`: the pipelines that come with tactflow."""

from __future__ import annotations

import argparse

from tactflow.config.shipped import described_pipelines


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare nothing but what follows the options."""
    parser.epilog = "for your sensor: tactflow run mini --source 0"


def run(args: argparse.Namespace) -> int:  # noqa: ARG001 (the same for all commands)
    """Print the name of each, and what it is for."""
    found = described_pipelines()
    width = max(map(len, found))
    for name, description in found.items():
        print(f"{name.ljust(width)}  {description}")
    return 0
