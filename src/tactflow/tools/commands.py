"""The commands of the tools, as `pyproject.toml` declares them in the group `tactflow.commands`."""

from __future__ import annotations

from typing import Final

from tactflow.cli.command import Command

START: Final = Command(
    "set up a sensor, step by step: from the camera to a pipeline file and live results",
    "tactflow.tools.start.command",
)
BENCH: Final = Command(
    "measure run time against error, per method and for whole pipelines", "tactflow.tools.bench.command"
)
STRESS: Final = Command(
    "measure numerical stability: perturbed, turned and degenerate pictures, long runs, other arithmetic",
    "tactflow.tools.stress.command",
)
BATCH: Final = Command(
    "run a pipeline over many recordings; a second call does what is missing", "tactflow.tools.batch.command"
)
DOCTOR: Final = Command(
    "diagnose a sensor's pictures: what is wrong, its effect on the errors, and what to change",
    "tactflow.tools.doctor.command",
)
TUNE: Final = Command(
    "find the cheapest pipeline within an error budget, for one sensor, from a recording of it",
    "tactflow.tools.tune.command",
)
REPORT: Final = Command(
    "make a page of any run: curves, largest contacts, what was skipped, where time went",
    "tactflow.tools.report.command",
)
