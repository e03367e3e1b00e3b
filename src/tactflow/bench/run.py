"""A whole run of the bench: scenes, methods, pipelines, recordings, promises."""

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
import numpy as np

from tactflow.bench import depth, gels, motion, recordings
from tactflow.bench.methods import CLASSIC, GROUPS, measure_methods
from tactflow.bench.pictures import draw
from tactflow.bench.pipelines import (
    Worst,
    growth,
    measure_pipelines,
    measure_refusal,
    on_recording,
    peak_memory_mb,
)
from tactflow.bench.results import Result
from tactflow.bench.scenes import (
    FULL,
    FULL_STAGES,
    QUICK,
    QUICK_STAGES,
    TROUBLES,
    Case,
    Rendered,
    render_all,
)
from tactflow.bench.targets import judge
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline

DEFAULT = "default"
MARKERLESS = "markerless"
WEDGE = "wedge"

GROWTH_FRAMES = 60
"""Frames on which it is measured how time grows with the picture: one press."""

MEMORY_FRAMES = 20
"""Frames that a process runs whose peak memory is taken; chosen by hand."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What to measure.

    files : pipeline name -> file. `DEFAULT` and `CLASSIC` must be among them.
    quick : a short run. data : folder of real recordings, or None. scenes : only these, or None for all.
    memory : whether to start each pipeline once more in a process of its own for its peak memory.
    pictures : folder for a picture of each pipeline's worst frame in each scene, or None.
    cases, stage_cases : scenes for whole pipelines, and for methods alone; empty: those of such a run.
    """

    files: Mapping[str, Path]
    quick: bool = False
    data: Path | None = None
    scenes: frozenset[str] | None = None
    memory: bool = True
    pictures: Path | None = None
    cases: tuple[Case, ...] = ()
    stage_cases: tuple[Case, ...] = ()

    def chosen(self) -> tuple[tuple[Case, ...], tuple[Case, ...]]:
        """The scenes for whole pipelines, and for methods alone.

        Raises
        ------
        ConfigError
            If no scene is left.
        """
        whole = self.cases or (QUICK if self.quick else (*FULL, *TROUBLES))
        alone = self.stage_cases or (QUICK_STAGES if self.quick else FULL_STAGES)
        if self.scenes is None:
            return whole, alone
        unknown = self.scenes - {case.label for case in whole}
        if unknown:
            known = ", ".join(case.label for case in whole)
            raise ConfigError(f"--scene {', '.join(sorted(unknown))}: not among the scenes measured: {known}")
        return (
            tuple(case for case in whole if case.label in self.scenes),
            tuple(case for case in alone if case.label in self.scenes),
        )


def machine() -> dict[str, str]:
    """What the numbers depend on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [
            line.split(":", 1)[1].strip()
            for line in cpuinfo.read_text(encoding="utf-8").splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    return {
        "CPU": f"{model} ({os.cpu_count()} cores, one thread used)",
        "Python": platform.python_version(),
        "OpenCV": cv2.__version__,
        "numpy": np.__version__,
        "numba": metadata.version("numba"),
    }


def _needs_rectifying(pipeline: Pipeline) -> bool:
    """Whether a pipeline is cut to one particular camera and makes no sense on the simulated one."""
    return any(
        getattr(node.params, "homography", None) is not None
        or getattr(node.params, "undistort", None) is not None
        for node in pipeline.nodes.values()
        if node.id == "preprocess"
    )


def run_bench(plan: Plan, progress: Callable[[str, int, int], None] = lambda *_: None) -> Result:
    """Measure everything of a plan.

    Parameters
    ----------
    progress : called with (what is being done, steps done, steps in all).

    Raises
    ------
    ConfigError
        If a pipeline file is wrong, a scene is unknown, or there are no recordings where they should be.
    """
    began = time.perf_counter()
    run = _Run(plan, progress)
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        scratch = Path(folder)
        run.scenes(scratch)
        growth = run.growth(scratch)
        run.peak_memory(scratch)
        run.recordings(scratch)
    result = run.finished(growth)
    result.wall_s = time.perf_counter() - began
    return result


class _Run:
    """A run of the bench: what it measures with, what it has found, and how far it is.

    general : pipelines for gels with markers. bare : for gels without.
    """

    def __init__(self, plan: Plan, progress: Callable[[str, int, int], None]) -> None:
        self.plan, self.progress = plan, progress
        self.whole, self.alone = plan.chosen()
        if plan.data is not None:
            recordings.check(plan.data)
        self.loaded = {name: load_pipeline(path) for name, path in plan.files.items()}
        self.general = {
            name: pipeline
            for name, pipeline in self.loaded.items()
            if not _needs_rectifying(pipeline) and name != MARKERLESS
        }
        made_for_them = self.loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS))
        self.bare = {
            MARKERLESS: made_for_them,
            CLASSIC: recordings.without_markers(self.loaded[CLASSIC]),
        }
        self.result = Result(quick=plan.quick, machine=machine())
        self.unit = CopyUnit()
        self.unit.take(20)
        self.doing, self.done, self.total = "rendering", 0, self._steps()

    def _steps(self) -> int:
        """Steps of the whole run: about one for each frame of a whole pipeline."""
        steps = sum(case.frames for case in self.whole) + len(GROUPS) * len(self.alone)
        steps += 1 if self.plan.quick else GROWTH_FRAMES
        if self.plan.memory:
            steps += MEMORY_FRAMES * len(self.general)
        if self.plan.data is not None:
            steps += recordings.frame_count(self.plan.data) + gels.step_count(self.plan.data)
        return steps

    def step(self, count: int = 1) -> None:
        """Say that so many steps more are done."""
        self.done += count
        self.progress(self.doing, min(self.done, self.total), self.total)

    def scenes(self, scratch: Path) -> None:
        """Whole pipelines, then methods alone, on simulated scenes."""
        found = self.result.measurements
        for rendered in render_all(self.whole, scratch):
            self.doing = f"pipelines on {rendered.case.label}"
            suited = self.general if len(rendered.scene.layout.rest) else self.bare
            if rendered.case in TROUBLES:
                # The script takes half of a run's time and was not made for any of this.
                suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
            if rendered.scene.settings.speckle:
                marked = on_recording(self.loaded[DEFAULT], rendered.path)
                found.append(measure_refusal(DEFAULT, marked, rendered.case.label, scratch))
            worst = _keeper(self.plan.pictures, rendered.case.label)
            found += measure_pipelines(suited, rendered, scratch, self.unit, self.step, worst)
        for rendered in render_all(self.alone, scratch):
            self.doing = f"methods on {rendered.case.label}"
            found += measure_methods(self.general, rendered, self.unit, self.step)
        if not self.plan.quick and self.plan.scenes is None:
            self.doing = "depth"
            found += depth.measure_simulated(self.unit)
            self.doing = "motion"
            found += motion.measure(self.unit)

    def growth(self, scratch: Path) -> float | None:
        """What `pipelines.growth` says of the default pipeline; None in a run that leaves it out."""
        if self.plan.quick or self.plan.scenes is not None:
            return None
        self.doing = "growth with size"
        rendered = Rendered(Case("press", GROWTH_FRAMES), scratch)
        grown = growth(self.loaded[DEFAULT], rendered, scratch, self.unit)
        rendered.path.unlink()
        self.step(GROWTH_FRAMES)
        return grown

    def peak_memory(self, scratch: Path) -> None:
        """The peak memory of each pipeline, in a process of its own."""
        if not self.plan.memory:
            return
        self.doing = "peak memory"
        rendered = Rendered(Case("press", MEMORY_FRAMES), scratch)
        for name, pipeline in self.general.items():
            sinks = [sink.id for sink in pipeline.sinks]
            peak = peak_memory_mb(self.plan.files[name], rendered.path, sinks)
            for measurement in self.result.of("pipeline", name):
                measurement.peak_mb = peak
            self.step(MEMORY_FRAMES)
        rendered.path.unlink()

    def recordings(self, scratch: Path) -> None:
        """Whole pipelines on the real recordings."""
        if self.plan.data is None:
            return
        self.doing = "recordings"
        wedge = {WEDGE: self.loaded[WEDGE], **self.general} if WEDGE in self.loaded else self.general
        measured = recordings.measure_recordings(
            wedge, self.bare, self.plan.data, scratch, self.unit, self.step
        )
        for measurements in measured:
            self.result.measurements += measurements
        ball = self.plan.data / "wedge_ball"
        if WEDGE in self.loaded and (ball / "labels.csv").exists():
            self.doing = "depth"
            self.result.measurements.append(depth.measure_ball(self.loaded[WEDGE], ball, scratch))
        self.result.measurements += gels.measure_gels(
            (DEFAULT, self.loaded[DEFAULT]),
            (MARKERLESS, self.bare[MARKERLESS]),
            self.plan.data,
            scratch,
            self.unit,
            self.step,
            self.plan.pictures,
        )

    def finished(self, growth: float | None) -> Result:
        """The result, its promises judged."""
        result = self.result
        unit = self.unit
        result.copy_ms, result.touch_ms, result.fault_us = unit.copy_ms, unit.touch_ms, unit.fault_us
        wedge = WEDGE if WEDGE in self.loaded else DEFAULT
        result.targets = judge(result, DEFAULT, growth, wedge=wedge, markerless=MARKERLESS)
        self.progress("done", self.total, self.total)
        return result


def _keeper(folder: Path | None, scene: str) -> Callable[[str, Worst], None]:
    """Writes pictures of worst frames to a folder, or does nothing."""

    def keep(pipeline: str, worst: Worst) -> None:
        if folder is None or worst.outcome is None or worst.truth is None:
            return
        caption = f"{scene}, frame {worst.outcome.frame.seq}, {pipeline}: hull IoU {worst.overlap:.2f}"
        region = np.asarray(worst.truth.contact_mask, dtype=np.uint8)
        picture = draw(worst.outcome, region, worst.truth.center, caption)
        if picture is not None:
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{scene}-{pipeline.replace('/', '_')}.png"), picture)

    return keep
