"""A whole run of the bench: scenes, methods, pipelines, recordings."""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

import cv2

from tactflow.bench import depth, gels, recordings
from tactflow.bench.lockstep import on_recording
from tactflow.bench.methods import measure_methods
from tactflow.bench.pipelines import CLASSIC, Bench
from tactflow.bench.results import BenchResult
from tactflow.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case, rendered
from tactflow.bench.score import PipelineScore
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

DEFAULT = "default"
MARKERLESS = "markerless"
WEDGE = "wedge"

Progress = Callable[[str, int, int], None]
"""Called with what is being done, steps done, and steps in all."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to measure.

    files : pipeline name -> file. `DEFAULT` and `CLASSIC` must be among them.
    quick : a short run. data : folder of real recordings, or None. scenes : only these, or None for all.
    pictures : folder for a picture of each pipeline's worst frame in each scene, or None.
    cases, stage_cases : scenes for whole pipelines, and for methods alone; empty: those of such a run.
    """

    files: Mapping[str, Path]
    quick: bool = False
    data: Path | None = None
    scenes: frozenset[str] | None = None
    pictures: Path | None = None
    cases: tuple[Case, ...] = ()
    stage_cases: tuple[Case, ...] = ()

    def chosen(self) -> tuple[list[Case], list[Case]]:
        """The scenes for whole pipelines, and for methods alone.

        Raises
        ------
        ConfigError
            If a scene is unknown.
        """
        whole = self.cases or (QUICK if self.quick else (*FULL, *TROUBLES))
        alone = self.stage_cases or (QUICK_STAGES if self.quick else FULL_STAGES)
        known = [case.label for case in whole]
        scenes = frozenset(known) if self.scenes is None else self.scenes
        if unknown := sorted(scenes.difference(known)):
            measured = ", ".join(known)
            raise ConfigError(f"--scene {', '.join(unknown)}: not among the scenes measured: {measured}")
        return [case for case in whole if case.label in scenes], [c for c in alone if c.label in scenes]


def run_bench(plan: Plan, progress: Progress = lambda *_: None) -> BenchResult:
    """Measure everything of a plan.

    Raises
    ------
    ConfigError
        If a pipeline file is wrong, a scene is unknown, or there are no recordings where they should be.
    """
    began = time.perf_counter()
    whole, alone = plan.chosen()
    if plan.data is not None:
        recordings.check(plan.data)
    loaded = {name: load_pipeline(path) for name, path in plan.files.items()}
    result, unit = BenchResult(quick=plan.quick, machine=machine()), CopyUnit()
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        run = _Run(Bench(result, unit, Path(folder), plan.pictures), loaded)
        steps = [(f"pipelines on {case.label}", partial(run.pipelines, case)) for case in whole]
        steps += [(f"methods on {case.label}", partial(run.methods, case)) for case in alone]
        if not plan.quick and plan.scenes is None:
            steps.append(("heights", partial(depth.measure_simulated, run.bench)))
        if plan.data is not None:
            if (plan.data / "wedge_ball" / "labels.csv").exists():
                steps.append(("presses of a ball", partial(run.presses, plan.data / "wedge_ball")))
            steps.append(("real gels", partial(run.gels, plan.data)))
        for number, (what, measure) in enumerate(steps):
            progress(what, number, len(steps))
            measure()
    progress("done", len(steps), len(steps))
    result.copy_ms, result.wall_s = unit.copy_ms, time.perf_counter() - began
    return result


class _Run:
    """What is measured, step by step.

    loaded : name -> pipeline. marked, bare : those for gels with markers, and without, on any camera.
    """

    def __init__(self, bench: Bench, loaded: Mapping[str, Pipeline]) -> None:
        self.bench, self.loaded = bench, loaded
        self.marked = {n: p for n, p in loaded.items() if not _is_for_one_camera(p) and n != MARKERLESS}
        self.bare = {
            MARKERLESS: loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS)),
            CLASSIC: recordings.without_markers(loaded[CLASSIC]),
        }

    def pipelines(self, case: Case) -> None:
        """Measure whole pipelines on a simulated scene."""
        with rendered(case, self.bench.scratch) as scene:
            suited = self.marked if len(scene.scene.layout.rest) else self.bare
            if case in TROUBLES:
                # The script takes half of a run's time and was not made for any of this.
                suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
            if scene.scene.settings.speckle:
                speckled = on_recording(self.loaded[DEFAULT], scene.path)
                self.bench.measure_refusal(DEFAULT, speckled, case.label)
            self.bench.measure(suited, case.label, [(scene.path, partial(PipelineScore, scene))])

    def methods(self, case: Case) -> None:
        """Measure the methods of each stage on a simulated scene."""
        with rendered(case, self.bench.scratch) as scene:
            measure_methods(self.bench, self.marked, scene)

    def presses(self, folder: Path) -> None:
        """Measure whole pipelines on presses of a real ball, and heights."""
        wedge = {WEDGE: self.loaded[WEDGE]} if WEDGE in self.loaded else {}
        recordings.measure_presses(self.bench, wedge | self.marked, folder)
        if wedge:
            depth.measure_ball(self.bench, self.loaded[WEDGE], folder)

    def gels(self, data: Path) -> None:
        """Measure the default and the markerless pipeline on recordings of many labs."""
        marked, bare = (DEFAULT, self.loaded[DEFAULT]), (MARKERLESS, self.bare[MARKERLESS])
        gels.measure_gels(self.bench, marked, bare, data)


def _is_for_one_camera(pipeline: Pipeline) -> bool:
    """Whether a pipeline rectifies one camera's picture and makes no sense on the simulated one."""
    node = pipeline.nodes.get("preprocess")
    return node is not None and any(
        getattr(node.params, name, None) is not None for name in ("homography", "undistort")
    )


def machine() -> dict[str, str]:
    """What the numbers depend on."""
    model = platform.processor() or platform.machine()
    if (cpuinfo := Path("/proc/cpuinfo")).exists():
        lines = cpuinfo.read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        model = names[0] if names else model
    versions = {name: metadata.version(name) for name in ("numpy", "numba")}
    cpu = f"{model} ({os.cpu_count()} cores, one thread used)"
    return {"CPU": cpu, "Python": platform.python_version(), "OpenCV": cv2.__version__, **versions}
