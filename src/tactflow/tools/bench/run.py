"""A whole run of the bench: scenes, methods, pipelines."""

from __future__ import annotations

import os
import platform
import re
import tempfile
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import partial
from importlib import metadata
from pathlib import Path

import cv2

from tactflow.config.load import load_pipeline
from tactflow.config.shipped import find_pipeline
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.tools.bench.lockstep import on_recording, take_turns
from tactflow.tools.bench.methods import measure_methods
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.results import CLASSIC, PIPELINE, BenchResult
from tactflow.tools.bench.scenes import FULL, FULL_STAGES, QUICK, QUICK_STAGES, TROUBLES, Case, rendered
from tactflow.tools.bench.score import PipelineScore

DEFAULT = "default"
MARKERLESS = "markerless"
_MARKER_STAGES = frozenset({"tracker", "flow_in_mask", "visualize"})
"""Ids of the stages that need markers."""

Progress = Callable[[str, int, int], None]
"""Called with what is being done, steps done, and steps in all."""
Pipelines = Mapping[str, Pipeline]
"""Name -> pipeline; `DEFAULT` and `CLASSIC` are among them."""


def run_bench(
    files: Mapping[str, Path],
    *,
    quick: bool = False,
    scenes: Collection[str] | None = None,
    progress: Progress = lambda *_: None,
) -> BenchResult:
    """Measure pipelines, and every method of their stages.

    files : pipeline name -> file; `DEFAULT` and `CLASSIC` must be among them. quick : a short run.
    scenes : only these, or None for all.

    Raises
    ------
    ConfigError
        If a pipeline file is wrong or a scene is unknown.
    """
    began = time.perf_counter()
    whole, alone = (QUICK, QUICK_STAGES) if quick else ((*FULL, *TROUBLES), FULL_STAGES)
    known = [case.label for case in whole]
    scenes = frozenset(known if scenes is None else scenes)
    if unknown := sorted(scenes.difference(known)):
        measured = ", ".join(known)
        raise ConfigError(f"--scene {', '.join(unknown)}: not among the scenes measured: {measured}")
    loaded = {name: load_pipeline(path) for name, path in files.items()}
    result = BenchResult(quick=quick, machine=machine())
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        shared = (result, Path(folder))
        steps = [
            (f"pipelines on {case.label}", partial(measure_scene, *shared, loaded, case))
            for case in whole
            if case.label in scenes
        ]
        steps += [
            (f"methods on {case.label}", partial(measure_methods, *shared, _marked(loaded), case))
            for case in alone
            if case.label in scenes
        ]
        for number, (what, measure) in enumerate(steps):
            progress(what, number, len(steps))
            measure()
    progress("done", len(steps), len(steps))
    result.wall_s = time.perf_counter() - began
    return result


def measure_scene(result: BenchResult, scratch: Path, loaded: Pipelines, case: Case) -> None:
    """Measure whole pipelines, in turns of a few frames, on a simulated scene.

    result : rows are added to it. scratch : folder for temporary files.
    """
    with rendered(case, scratch) as scene:
        suited = _marked(loaded) if len(scene.scene.layout.rest) else _bare(loaded)
        if case in TROUBLES:
            # The script takes half of a run's time and was not made for any of this.
            suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
        scores = {name: PipelineScore(scene, Tally()) for name in suited}
        ready = {name: on_recording(pipeline, scene.path) for name, pipeline in suited.items()}
        times, failures = take_turns(ready, lambda name, found: scores[name].add(found))
    for name, score in scores.items():
        if name in failures:
            result.failures[f"{PIPELINE}/{name}/{case.label}"] = failures[name]
        else:
            errors, frames = score.tally.errors(), sum(map(len, times[name].values()))
            result.add(PIPELINE, name, case.label, errors, times=times[name], frames=frames)


def _marked(loaded: Pipelines) -> dict[str, Pipeline]:
    """The pipelines for gels with markers, on any camera."""
    return {n: p for n, p in loaded.items() if n != MARKERLESS and not _is_for_one_camera(p)}


def _bare(loaded: Pipelines) -> dict[str, Pipeline]:
    """The pipelines for gels without markers: that of the script, without the stages that need them."""
    markerless = loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS))
    nodes = {n: node for n, node in loaded[CLASSIC].nodes.items() if n not in _MARKER_STAGES}
    return {MARKERLESS: markerless, CLASSIC: replace(loaded[CLASSIC], nodes=nodes)}


def _is_for_one_camera(pipeline: Pipeline) -> bool:
    """Whether a pipeline rectifies one camera's picture and makes no sense on the simulated one."""
    params = pipeline.nodes["preprocess"].params if "preprocess" in pipeline.nodes else None
    return any(getattr(params, name, None) is not None for name in ("homography", "undistort"))


def machine() -> dict[str, str]:
    """What the numbers depend on."""
    cpuinfo = Path("/proc/cpuinfo")
    models = re.findall(r"model name\s*: (.*)", cpuinfo.read_text()) if cpuinfo.exists() else []
    model = models[0] if models else platform.processor() or platform.machine()
    versions = {name: metadata.version(name) for name in ("numpy", "numba")}
    cpu = f"{model} ({os.cpu_count()} cores, one thread used)"
    return {"CPU": cpu, "Python": platform.python_version(), "OpenCV": cv2.__version__, **versions}
