"""A whole run of the bench: scenes, methods, pipelines, recordings, promises."""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from tactflow.bench import recordings
from tactflow.bench.methods import CLASSIC, measure_methods
from tactflow.bench.pictures import draw
from tactflow.bench.pipelines import PLAIN, Worst, growth, measure_pipelines, peak_memory_mb
from tactflow.bench.results import Measurement, Result
from tactflow.bench.scenes import (
    FULL,
    FULL_STAGES,
    NOMINAL,
    QUICK,
    QUICK_STAGES,
    Case,
    Rendered,
    render_all,
)
from tactflow.bench.targets import judge
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.vision import compiled

DEFAULT = "default"
MARKERLESS = "markerless"
WEDGE = "wedge"


@dataclass(frozen=True, slots=True)
class Plan:
    """What to measure.

    files : pipeline name -> file. `DEFAULT` and `CLASSIC` must be among them.
    quick : a short run. data : folder of real recordings, or None. scenes : only these, or None for all.
    memory : whether to start each pipeline once more in a process of its own for its peak memory.
    pictures : folder for a picture of each pipeline's worst frame in each scene, or None.
    """

    files: Mapping[str, Path]
    quick: bool = False
    data: Path | None = None
    scenes: frozenset[str] | None = None
    memory: bool = True
    pictures: Path | None = None
    cases: tuple[Case, ...] = field(default=())
    stage_cases: tuple[Case, ...] = field(default=())

    def chosen(self) -> tuple[tuple[Case, ...], tuple[Case, ...]]:
        """The scenes for whole pipelines, and for methods alone.

        Raises
        ------
        ConfigError
            If no scene is left.
        """
        whole = self.cases or (QUICK if self.quick else FULL)
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
        "numba": compiled.numba_version() or "not used",
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
    whole, alone = plan.chosen()
    if plan.data is not None:
        recordings.check(plan.data)
    loaded = {name: load_pipeline(path) for name, path in plan.files.items()}
    general = {name: p for name, p in loaded.items() if not _needs_rectifying(p) and name != MARKERLESS}
    # For gels without markers: the pipeline made for them, else the default one without its tracker.
    bare = {name: recordings.without_markers(loaded[name]) for name in (DEFAULT, CLASSIC)}
    if MARKERLESS in loaded:
        bare = {MARKERLESS: loaded[MARKERLESS], CLASSIC: bare[CLASSIC]}
    compared = not plan.quick and compiled.active()
    total = sum(case.frames for case in whole) + 7 * len(alone) + (1 if plan.quick else 60)
    if plan.memory:
        total += 20 * len(general)
    if plan.data is not None:
        total += recordings.frame_count(plan.data)
    done = 0
    doing = "rendering"

    def step(count: int = 1) -> None:
        nonlocal done
        done += count
        progress(doing, min(done, total), total)

    result = Result(quick=plan.quick, machine=machine())
    unit = CopyUnit()
    unit.take(20)
    grown: float | None = None
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as name:
        scratch = Path(name)
        for rendered in render_all(whole, scratch):
            doing = f"pipelines on {rendered.case.label}"
            suited = general if len(rendered.scene.layout.rest) else bare
            if compared and rendered.case.label in NOMINAL:
                suited = {**suited, PLAIN: loaded[DEFAULT]}
            worst = _keeper(plan.pictures, rendered.case.label)
            result.measurements += measure_pipelines(suited, rendered, scratch, unit, step, worst)
        for rendered in render_all(alone, scratch):
            doing = f"methods on {rendered.case.label}"
            result.measurements += measure_methods(general, rendered, unit, step)
        if not plan.quick and plan.scenes is None:
            doing = "growth with size"
            rendered = Rendered(Case("press", 60), scratch)
            grown = growth(loaded[DEFAULT], rendered, scratch, unit)
            rendered.path.unlink()
            step(60)
        if plan.memory:
            doing = "peak memory"
            _peak_memory(plan, general, result.measurements, scratch, step)
        if plan.data is not None:
            doing = "recordings"
            wedge = {WEDGE: loaded[WEDGE], **general} if WEDGE in loaded else general
            for measured in recordings.measure_recordings(wedge, bare, plan.data, scratch, unit, step):
                result.measurements += measured
    result.copy_ms, result.touch_ms = unit.copy_ms, unit.touch_ms
    markerless, wedge_name = (name if name in loaded else DEFAULT for name in (MARKERLESS, WEDGE))
    result.targets = judge(result, DEFAULT, grown, wedge=wedge_name, markerless=markerless)
    result.wall_s = time.perf_counter() - began
    progress("done", total, total)
    return result


def _keeper(folder: Path | None, scene: str) -> Callable[[str, Worst], None]:
    """Writes pictures of worst frames to a folder, or does nothing."""

    def keep(pipeline: str, worst: Worst) -> None:
        if folder is None or worst.outcome is None or worst.truth is None:
            return
        caption = f"{scene}, frame {worst.outcome.frame.seq}, {pipeline}: hull IoU {worst.overlap:.2f}"
        picture = draw(worst.outcome, worst.truth, caption)
        if picture is not None:
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"{scene}-{pipeline.replace('/', '_')}.png"), picture)

    return keep


def _peak_memory(
    plan: Plan,
    pipelines: Mapping[str, Pipeline],
    measurements: list[Measurement],
    scratch: Path,
    step: Callable[[int], None],
) -> None:
    rendered = Rendered(Case("press", 20), scratch)
    for name, pipeline in pipelines.items():
        peak = peak_memory_mb(plan.files[name], rendered.path, [sink.id for sink in pipeline.sinks])
        for measurement in measurements:
            if (measurement.group, measurement.method) == ("pipeline", name):
                measurement.peak_mb = peak
        step(20)
    rendered.path.unlink()
