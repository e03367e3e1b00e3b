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
from tactflow.tools.bench.costs import measure_costs
from tactflow.tools.bench.depth import DEPTH, DEPTH_SCENES, simulated_calibration, with_depth
from tactflow.tools.bench.growth import measure_growth
from tactflow.tools.bench.latency import measure_latency
from tactflow.tools.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.tools.bench.methods import measure_methods
from tactflow.tools.bench.pictures import deepest_frame, found_picture, true_picture
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.results import CLASSIC, PIPELINE, TRUTH, UNSKIPPED, BenchResult
from tactflow.tools.bench.scenes import (
    FULL,
    FULL_STAGES,
    QUICK,
    QUICK_STAGES,
    TROUBLES,
    Case,
    Rendered,
    rendered,
)
from tactflow.tools.bench.score import PipelineScore

DEFAULT = "default"
MARKERLESS = "markerless"
GRASP_FRAMES = 360
"""Frames of the simulated press whose frames are costed one by one, and played at a camera's pace."""
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
    recording: Path | None = None,
    progress: Progress = lambda *_: None,
) -> BenchResult:
    """Measure pipelines, every method of their stages, where time goes, and how it grows.

    files : pipeline name -> file; `DEFAULT` and `CLASSIC` must be among them. quick : a short run.
    scenes : only these, or None for all, with the costs, growth and latency, which have scenes of their own.
    recording : whose frames are costed one by one; None: a simulated press.

    Raises
    ------
    ConfigError
        If a pipeline file is wrong or a scene is unknown.
    """
    began = time.perf_counter()
    whole, alone = (QUICK, QUICK_STAGES) if quick else ((*FULL, *TROUBLES), FULL_STAGES)
    known = [case.label for case in whole]
    everything = scenes is None
    scenes = frozenset(known if scenes is None else scenes)
    if unknown := sorted(scenes.difference(known)):
        measured = ", ".join(known)
        raise ConfigError(f"--scene {', '.join(unknown)}: not among the scenes measured: {measured}")
    loaded = {name: load_pipeline(path) for name, path in files.items()}
    result = BenchResult(quick=quick, machine=machine())
    with tempfile.TemporaryDirectory(prefix="tactflow-bench-") as folder:
        shared = (result, Path(folder))
        steps: list[tuple[str, Callable[[], None]]] = [
            (f"pipelines on {case.label}", partial(measure_scene, *shared, loaded, case))
            for case in whole
            if case.label in scenes
        ]
        steps += [
            (f"methods on {case.label}", partial(measure_methods, *shared, _marked(loaded), case))
            for case in alone
            if case.label in scenes
        ]
        if everything and not quick:
            steps += [
                (f"depth on {case.label}", partial(measure_depth, *shared, loaded, case))
                for case in DEPTH_SCENES
            ]
        if everything or recording is not None:
            steps += _further_steps(result, Path(folder), loaded, recording)
        for number, (what, measure) in enumerate(steps):
            progress(what, number, len(steps))
            measure()
    progress("done", len(steps), len(steps))
    result.wall_s = time.perf_counter() - began
    return result


def measure_scene(result: BenchResult, scratch: Path, loaded: Pipelines, case: Case) -> None:
    """Measure whole pipelines on a simulated scene, and keep a picture of its deepest frame.

    result : rows are added to it. scratch : folder for temporary files.
    """
    with rendered(case, scratch) as scene:
        suited = _suited(loaded, scene)
        if case in TROUBLES:
            # The script takes half of a run's time and was not made for any of this.
            suited = {name: pipeline for name, pipeline in suited.items() if name != CLASSIC}
        deepest = deepest_frame(scene)
        shown: dict[str, bytes] = {}

        def look(name: str, found: TimedResult) -> None:
            if found.seq == deepest:
                if found.mapping is not None and not shown:
                    shown[TRUTH] = true_picture(found, scene.truths(found.mapping)[deepest])
                shown[name] = found_picture(found)

        _measure(result, PIPELINE, suited, scene, look)
    result.pictures[case.label] = shown


def measure_depth(result: BenchResult, scratch: Path, loaded: Pipelines, case: Case) -> None:
    """Measure pipelines with a calibration, and other stages for the depth, on a simulated scene.

    result, scratch : as for `measure_scene`.
    """
    with rendered(case, scratch) as scene:
        calibrated = with_depth(_suited(loaded, scene), simulated_calibration(), DEFAULT)
        _measure(result, DEPTH, calibrated, scene)


def _measure(
    result: BenchResult,
    group: str,
    pipelines: Pipelines,
    scene: Rendered,
    look: Callable[[str, TimedResult], None] = lambda *_: None,
) -> None:
    """Measure whole pipelines, in turns of a few frames. look : is shown every result."""
    scores = {name: PipelineScore(scene, Tally()) for name in pipelines}
    ready = {name: on_recording(pipeline, scene.path) for name, pipeline in pipelines.items()}

    def observe(name: str, found: TimedResult) -> str:
        look(name, found)
        return scores[name].add(found)

    times, failures = take_turns(ready, observe)
    label = scene.case.label
    for name, score in scores.items():
        if name in failures:
            result.failures[f"{group}/{name}/{label}"] = failures[name]
        else:
            errors, frames = score.tally.errors(), sum(map(len, times[name].values()))
            result.add(group, name, label, errors, times=times[name], frames=frames)


def _suited(loaded: Pipelines, scene: Rendered) -> dict[str, Pipeline]:
    """The pipelines for a gel with or without markers, as the scene has it."""
    return _marked(loaded) if len(scene.scene.layout.rest) else _bare(loaded)


def _further_steps(
    result: BenchResult, folder: Path, loaded: Pipelines, recording: Path | None
) -> list[tuple[str, Callable[[], None]]]:
    """What is measured beside errors: costs by stage, growth, latency."""
    frames = GRASP_FRAMES // 4 if result.quick else GRASP_FRAMES
    case = Case("press", frames)
    source = recording or folder / "grasp.npy"

    def costs() -> None:
        if recording is None:
            with rendered(case, folder) as scene:
                scene.path.rename(source)
        # The script would take a third of a quick run.
        left_out = {CLASSIC} if result.quick else set()
        suited = {name: p for name, p in loaded.items() if not _is_for_one_camera(p) and name not in left_out}
        own = next((name for name in reversed(suited) if name not in (CLASSIC, MARKERLESS)), DEFAULT)
        suited[f"{own}{UNSKIPPED}"] = replace(loaded[own], skipping=False)
        failures: dict[str, str] = {}
        measured = measure_costs(suited, source, failures)
        result.failures |= {f"{PIPELINE}/{name}/{source.name}": why for name, why in failures.items()}
        result.costs = {name: cost.by_stage() for name, cost in measured.items() if name in loaded}
        result.grasp = (recording.name if recording else "a simulated press", measured)

    def growth() -> None:
        markerless = loaded.get(MARKERLESS) or load_pipeline(find_pipeline(MARKERLESS))
        result.growth = list(measure_growth(loaded[DEFAULT], markerless, quick=result.quick))

    def latency() -> None:
        result.latency_ms = measure_latency(loaded[DEFAULT], source)

    return [("costs", costs), ("growth", growth), ("latency", latency)]


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
    versions = {name: metadata.version(name) for name in ("numpy",)}
    cpu = f"{model} ({os.cpu_count()} cores, one thread used)"
    return {"CPU": cpu, "Python": platform.python_version(), "OpenCV": cv2.__version__, **versions}
