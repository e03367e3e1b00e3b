"""A whole run of the bench: scenes, methods, pipelines, recordings."""

from __future__ import annotations

import os
import platform
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
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
from tactflow.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case, Rendered
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


@dataclass(frozen=True, slots=True)
class Pipelines:
    """Name -> pipeline.

    loaded : all of them. marked, bare : for gels with markers, and without; none that rectifies one camera's
    picture and makes no sense on others.
    """

    loaded: Mapping[str, Pipeline]
    marked: Mapping[str, Pipeline]
    bare: Mapping[str, Pipeline]

    @classmethod
    def load(cls, files: Mapping[str, Path]) -> Pipelines:
        """Read the files. ConfigError if one is wrong."""
        loaded = {name: load_pipeline(path) for name, path in files.items()}
        marked = {n: p for n, p in loaded.items() if not _is_for_one_camera(p) and n != MARKERLESS}
        markerless = loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS))
        return cls(
            loaded, marked, {MARKERLESS: markerless, CLASSIC: recordings.without_markers(loaded[CLASSIC])}
        )


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
    pipelines = Pipelines.load(plan.files)
    result, unit = BenchResult(quick=plan.quick, machine=machine()), CopyUnit()
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        bench = Bench(result, unit, Path(folder), plan.pictures)
        steps = [(f"pipelines on {c.label}", partial(_measure_pipelines, bench, pipelines, c)) for c in whole]
        steps += [(f"methods on {c.label}", partial(_measure_methods, bench, pipelines, c)) for c in alone]
        if not plan.quick and plan.scenes is None:
            steps.append(("heights", partial(depth.measure_simulated, bench)))
        if plan.data is not None:
            steps.append(("recordings", partial(_measure_recordings, bench, pipelines, plan.data)))
            steps.append(("real gels", partial(_measure_gels, bench, pipelines, plan.data)))
        for number, (what, measure) in enumerate(steps):
            progress(what, number, len(steps))
            measure()
    progress("done", len(steps), len(steps))
    result.copy_ms, result.wall_s = unit.copy_ms, time.perf_counter() - began
    return result


@contextmanager
def _rendered(case: Case, folder: Path) -> Iterator[Rendered]:
    """A rendered scene, whose file is removed after the block."""
    rendered = Rendered(case, folder)
    try:
        yield rendered
    finally:
        rendered.path.unlink(missing_ok=True)


def _measure_pipelines(bench: Bench, pipelines: Pipelines, case: Case) -> None:
    with _rendered(case, bench.scratch) as rendered:
        suited = pipelines.marked if len(rendered.scene.layout.rest) else pipelines.bare
        if case in TROUBLES:
            # The script takes half of a run's time and was not made for any of this.
            suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
        if rendered.scene.settings.speckle:
            speckled = on_recording(pipelines.loaded[DEFAULT], rendered.path)
            bench.measure_refusal(DEFAULT, speckled, case.label)
        bench.measure(suited, case.label, [(rendered.path, partial(PipelineScore, rendered))])


def _measure_methods(bench: Bench, pipelines: Pipelines, case: Case) -> None:
    with _rendered(case, bench.scratch) as rendered:
        measure_methods(bench, pipelines.marked, rendered)


def _measure_recordings(bench: Bench, pipelines: Pipelines, data: Path) -> None:
    loaded = pipelines.loaded
    wedge = {WEDGE: loaded[WEDGE]} if WEDGE in loaded else {}
    recordings.measure_recordings(bench, wedge | dict(pipelines.marked), pipelines.bare, data)
    if wedge and (data / "wedge_ball" / "labels.csv").exists():
        depth.measure_ball(bench, loaded[WEDGE], data / "wedge_ball")


def _measure_gels(bench: Bench, pipelines: Pipelines, data: Path) -> None:
    marked, bare = (DEFAULT, pipelines.loaded[DEFAULT]), (MARKERLESS, pipelines.bare[MARKERLESS])
    gels.measure_gels(bench, marked, bare, data)


def _is_for_one_camera(pipeline: Pipeline) -> bool:
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
