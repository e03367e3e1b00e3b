"""Depth: pipelines with a calibration, and the stages that can take the place of `depth`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Final

import tactflow
from tactflow.calibration.presses import PressFinder
from tactflow.calibration.session import Wish, learn
from tactflow.config.replacements import replacements
from tactflow.engine.graph import Pipeline
from tactflow.tools.bench.scenes import Case

DEPTH: Final = "depth"
"""Group of the rows about depth, and id of the stage."""
PRESSES: Final = Case("ball", 300)
"""The presses of a ball that the calibration is made from."""
PITCH_MM, BALL_RADIUS_MM = 1.724, 2.375
"""Spacing of the dots of the simulated gel, and radius of that ball."""
DEPTH_SCENES: Final = (
    Case("press", 100),
    Case("cable", 100),
    Case("box", 60),
    Case("coin", 60),
    Case("unmarked", 60),
)
"""Round, long, angular and flat objects; none of them was calibrated with."""


@cache
def simulated_calibration() -> Path:
    """The calibration file of the simulated sensor, learned from presses of a ball as `calibrate` does."""
    finder = PressFinder()
    source = f"sim:{PRESSES.name}?frames={PRESSES.frames}"
    for result in tactflow.stream("default", source=source, settings={"calibration": None}, images=True):
        finder.add(result)
    wish = Wish(pitch=PITCH_MM, ball_radius=BALL_RADIUS_MM)
    found = learn(finder.session(), wish, None, lambda _: None, sensor="main", made_from=source)
    path = Path(mkdtemp(prefix="tactflow-bench-")) / "main.yaml"
    found.save(path)
    return path


def with_depth(pipelines: Mapping[str, Pipeline], calibration: Path, swapped: str) -> dict[str, Pipeline]:
    """The pipelines that measure depth, calibrated; one of them also with every other stage in its place.

    swapped : name of that one.
    """
    found: dict[str, Pipeline] = {}
    for name, pipeline in pipelines.items():
        if DEPTH not in pipeline.nodes:
            continue
        found[name] = calibrated = replace(pipeline, calibration=calibration)
        node = calibrated.nodes[DEPTH]
        used = [node.component for node in pipeline.nodes.values()]
        for other in replacements(node.component, used) if name == swapped else ():
            nodes = {**calibrated.nodes, DEPTH: replace(node, component=other, params=other.params())}
            found[other.name] = replace(calibrated, nodes=nodes)
    return found
