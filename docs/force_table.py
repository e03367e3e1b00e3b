"""The tables of force.md: forces of objects that the fit has not seen.

    python docs/force_table.py RECORDINGS

RECORDINGS holds the folder `wedge_grasp`: grasps of several objects, and beside each video a CSV with the
force. Takes about two minutes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.bench.depth import BALL, scale, session_of
from tactflow.calibration.file import Calibration, ForceEntry, raw_corners, small_picture
from tactflow.calibration.force import Aligned, Watched, align, fit_force, watch
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.reference import Reference, nonnegative, read_reference
from tactflow.calibration.scale import centre
from tactflow.engine.graph import Pipeline
from tactflow.sim import open_scene
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

GEL_MM = 0.1
"""Millimetres per processed pixel that wedge_grasp is given: the force does not depend on it. Not known."""
SCENES = ("ball?shear=0.6", "press?shear=0.6", "slide", "stick_slip", "cable", "box")
"""Simulated scenes beside which a gauge is read."""

Double = NDArray[np.float64]


def grasps(folder: Path, scratch: Path) -> tuple[dict[str, Watched], dict[str, Reference]]:
    """What is seen of each object of wedge_grasp, and its force."""
    watched, references = {}, {}
    for file in sorted(folder.glob("*.csv")):
        pipeline = tactflow.load(
            "markerless",
            source=str(file.with_suffix(".avi")),
            settings={"stages.preprocess.rotate": 0},
        )
        _calibration(pipeline, scratch)
        watched[file.stem] = watch(pipeline, scratch / "wedge.yaml")
        references[file.stem] = read_reference(file)
    return watched, references


def _calibration(pipeline: Pipeline, scratch: Path) -> None:
    """A calibration with a scale only, of the gel as it looks in the first frame."""
    first = next(tactflow.stream(pipeline, max_frames=1, images=True))
    assert first.image is not None
    size = (first.image.shape[1], first.image.shape[0])
    mapping = Preprocessor((640, 480), downsample=2).mapping
    known = Scale(GEL_MM, GEL_MM, (0.0, 0.0), centre(size))
    look = small_picture(first.image)
    made = Calibration("wedge", "wedge_grasp", (640, 480), size, raw_corners(mapping), look, known, "guess")
    made.save(scratch / "wedge.yaml")


def predicted(entry: ForceEntry, one: Aligned, names: list[str]) -> tuple[Double, Double]:
    """(n,) force z of each frame with contact, and its standard error, N."""
    model = entry.model().press
    values = np.array([model.value(dict(zip(names, row, strict=True))) for row in one.press])
    return values, np.array([model.stderr(value) for value in values])


def print_grasps(watched: dict[str, Watched], references: dict[str, Reference]) -> None:
    """One line for each object, fitted to the others."""
    print("| object | force, N | model | stated, N | area alone | change alone |")
    print("| --- | --- | --- | --- | --- | --- |")
    within = []
    for name in watched:
        others = [other for other in watched if other != name]
        fit = fit_force({o: watched[o] for o in others}, {o: references[o] for o in others})
        rest = fit.entry.change_at_rest
        aligned = {other: align(other, watched[other], references[other], rest) for other in watched}
        one, names = aligned[name], list(watched[name].press)
        force = one.force[:, 2]
        value, stderr = predicted(fit.entry, one, names)
        within.append(np.abs(value - force) / stderr)
        cells = [_quality(value, force), f"{np.median(stderr):.1f}"]
        for column in (names.index("area"), names.index("change")):
            known = np.concatenate([aligned[o].press[:, [column]] for o in others])
            stiffness = nonnegative(known, np.concatenate([aligned[o].force[:, 2] for o in others]))
            cells.append(_quality(one.press[:, [column]] @ stiffness, force))
        print(f"| {name} | {force.min():.1f} to {force.max():.1f} | {' | '.join(cells)} |")
    print(f"within one stated standard error, and two: {_shares(np.concatenate(within))} %")


def _quality(value: Double, force: Double) -> str:
    left = value - force
    explained = 1 - (left @ left) / ((force - force.mean()) @ (force - force.mean()))
    return f"{np.sqrt(np.mean(left**2)):.2f} N, {explained:.2f}"


def _shares(errors: Double) -> str:
    return f"{100 * np.mean(errors < 1):.0f}, {100 * np.mean(errors < 2):.0f}"


def print_simulated(scratch: Path) -> None:
    """One line for each scene, of another seed than the fit has seen."""
    session = session_of(open_scene("ball?frames=600"))
    learned = fit_photometry(session, scale(), BALL)
    mapping = Preprocessor((800, 600), rotate=90, downsample=2).mapping
    corners, look = raw_corners(mapping), small_picture(session.untouched)
    Calibration(
        "main",
        "sim:ball",
        (800, 600),
        mapping.size,
        corners,
        look,
        scale(),
        "truth",
        learned.model,
        learned.found,
    ).save(scratch / "main.yaml")
    seen = {spec: _simulated(spec, 1, scratch) for spec in SCENES}
    entry = fit_force({k: v[0] for k, v in seen.items()}, {k: v[1] for k, v in seen.items()}).entry
    press, drag = entry.press, entry.drag
    assert drag is not None
    print(
        f"z: {press.rmse:.2f} N RMS, {press.r2:.2f}, by scenes that the fit has not seen; {press.stiffness}"
    )
    print(f"x, y: {drag.rmse:.3f} N RMS, {drag.r2:.2f}; {drag.stiffness}")
    print("| scene | z, N | z | within one, two, % | x and y, N | x and y | within one, two, % |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for spec in SCENES:
        watched, reference = _simulated(spec, 2, scratch)
        one = align(spec, watched, reference, entry.change_at_rest)
        value, stderr = predicted(entry, one, list(watched.press))
        cells = [spec, f"0 to {one.force[:, 2].max():.1f}", _quality(value, one.force[:, 2])]
        cells.append(_shares(np.abs(value - one.force[:, 2]) / stderr))
        known = np.isfinite(one.drag).all(axis=1)
        # The scenes are turned by 90 degrees on their way into the processed frame.
        true = np.concatenate([-one.force[known, 1], one.force[known, 0]])
        given = {name: one.drag[known, i] for i, name in enumerate(watched.drag)}
        value = np.array(sum(drag.stiffness[name] * values for name, values in given.items()))
        flat = np.concatenate([value.real, value.imag])
        stderr = np.hypot(drag.error[0], drag.error[1] * flat)
        cells += [f"{np.abs(true).max():.2f}", _quality(flat, true), _shares(np.abs(flat - true) / stderr)]
        print(f"| {' | '.join(cells)} |")


def _simulated(spec: str, seed: int, scratch: Path) -> tuple[Watched, Reference]:
    spec = f"{spec}{'&' if '?' in spec else '?'}frames=300&seed={seed}"
    scene = open_scene(spec)
    force = np.array([scene.truth(i).force for i in range(len(scene))])
    pipeline = tactflow.load(source=f"sim:{spec}")
    times = np.arange(len(scene)) / scene.fps
    return watch(pipeline, scratch / "main.yaml"), Reference(spec, times, False, force)


if __name__ == "__main__":
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        print_grasps(*grasps(Path(sys.argv[1]) / "wedge_grasp", Path(name)))
        print_simulated(Path(name))
