"""A whole run of the bench: scenes, methods, pipelines, recordings."""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import cv2

from tactflow.bench import depth, gels, motion, recordings
from tactflow.bench.lockstep import on_recording
from tactflow.bench.methods import STAGES, measure_methods
from tactflow.bench.pipelines import CLASSIC, measure_pipelines, measure_refusal
from tactflow.bench.results import BenchResult
from tactflow.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case, render_all
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
    run = _Run(plan, progress)
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        run.scenes(Path(folder))
        if not plan.quick and plan.scenes is None:
            run.doing = "depth and motion"
            depth.measure_simulated(run.result)
            motion.measure_motion(run.result)
        if plan.data is not None:
            run.recordings(Path(folder), plan.data)
    run.step(run.total)
    run.result.copy_ms = run.unit.copy_ms
    run.result.wall_s = time.perf_counter() - began
    return run.result


class _Run:
    """A run of the bench: what it measures with, what it has found, and how far it is.

    marked : pipelines for gels with markers. bare : for gels without.
    """

    def __init__(self, plan: Plan, progress: Progress) -> None:
        self.plan, self.progress = plan, progress
        self.whole, self.alone = plan.chosen()
        if plan.data is not None:
            recordings.check(plan.data)
        self.loaded = {name: load_pipeline(path) for name, path in plan.files.items()}
        special = {name for name, pipeline in self.loaded.items() if _is_for_one_camera(pipeline)}
        self.marked = {n: p for n, p in self.loaded.items() if n not in special and n != MARKERLESS}
        self.bare = {
            MARKERLESS: self.loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS)),
            CLASSIC: recordings.without_markers(self.loaded[CLASSIC]),
        }
        self.result = BenchResult(quick=plan.quick, machine=machine())
        self.unit = CopyUnit()
        self.doing, self.done, self.total = "rendering", 0, self._steps()

    def _steps(self) -> int:
        """Steps of the whole run: about one for each frame of a whole pipeline."""
        steps = 1 + sum(case.frames for case in self.whole) + len(STAGES) * len(self.alone)
        if self.plan.data is not None:
            steps += recordings.frame_count(self.plan.data) + gels.step_count(self.plan.data)
        return steps

    def step(self, count: int) -> None:
        """Report that so many more steps are done."""
        self.done = min(self.done + count, self.total)
        self.progress(self.doing, self.done, self.total)

    def scenes(self, scratch: Path) -> None:
        """Measure whole pipelines, then methods alone, on simulated scenes."""
        for rendered in render_all(self.whole, scratch):
            label = rendered.case.label
            self.doing = f"pipelines on {label}"
            suited = self.marked if len(rendered.scene.layout.rest) else self.bare
            if rendered.case in TROUBLES:
                # The script takes half of a run's time and was not made for any of this.
                suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
            if rendered.scene.settings.speckle:
                speckled = on_recording(self.loaded[DEFAULT], rendered.path)
                measure_refusal(self.result, DEFAULT, speckled, label)
            measure_pipelines(self.result, suited, rendered, self.unit, self.step, self.plan.pictures)
        for rendered in render_all(self.alone, scratch):
            self.doing = f"methods on {rendered.case.label}"
            measure_methods(self.result, self.marked, rendered, self.unit, self.step)

    def recordings(self, scratch: Path, data: Path) -> None:
        """Measure whole pipelines on the real recordings."""
        self.doing = "recordings"
        bench = recordings.Bench(self.result, self.unit, self.step, scratch)
        wedge = {WEDGE: self.loaded[WEDGE]} if WEDGE in self.loaded else {}
        recordings.measure_recordings(bench, wedge | self.marked, self.bare, data)
        if wedge and (data / "wedge_ball" / "labels.csv").exists():
            depth.measure_ball(self.result, self.loaded[WEDGE], data / "wedge_ball", scratch)
        marked, bare = (DEFAULT, self.loaded[DEFAULT]), (MARKERLESS, self.bare[MARKERLESS])
        gels.measure_gels(self.result, marked, bare, data, self.unit, self.step, self.plan.pictures)


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
