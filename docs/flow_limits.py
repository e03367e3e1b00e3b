"""The numbers and the picture of flow-limits.md: how well the mean flow in a contact can be known.

    python docs/flow_limits.py

prints the table and writes flow-limits.svg beside this file. Takes about two minutes.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import metrics
from tactflow.bench.lockstep import LockstepPipeline
from tactflow.bench.pipelines import on_recording
from tactflow.bench.scenes import FULL, NOMINAL, render_all
from tactflow.bench.score import FlowScore
from tactflow.config.load import load_pipeline
from tactflow.sim import Scene
from tactflow.sim.gel import reached
from tactflow.vision.contact.inside import outline_depth
from tactflow.vision.flow import HIDDEN

Values = NDArray[np.float64]

PIPELINE = Path(__file__).resolve().parents[1] / "pipeline.yaml"
TARGET = 0.15
SCALE = 0.5
"""Processed pixels to a raw one."""
SIGMA = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.25, 1.5)
DRAWS = 400
NEAR = 3.0
"""Marks nearer than this to the true outline tell how well it is known at marks, px."""
COLOURS = (
    "#1f4e79", "#c0392b", "#4a7a3f", "#d9a300", "#7d3c98", "#16a085",
    "#d35400", "#2c3e50", "#8e6e53", "#c2185b", "#00838f",
)  # fmt: skip


@dataclass(frozen=True)
class Curve:
    """One scene.

    expected : (S,) px, mean error for each of `SIGMA`. measured : px, of the default pipeline.
    decided : px, the same over the frames in which no marker is at the edge (`Truth.at_edge`).
    sigma : px, standard deviation of its outline at the markers; None where there are too few.
    """

    name: str
    expected: Values
    measured: float | None
    decided: float | None
    sigma: float | None


def true_depth(scene: Scene, index: int) -> Values:
    """(N,) processed px: how deep each marker lies in the contact, exact to first order near its outline."""
    points = scene.camera.to_gel(scene.truth(index, None).position).astype(np.float32)
    x, y = points.T
    best = np.full(len(points), -np.inf)
    for press in scene.presses(index):
        if not press.touching:
            continue

        def level(dx: float, dy: float, press: object = press) -> Values:
            return reached(press, x + np.float32(dx), y + np.float32(dy)).astype(np.float64)  # type: ignore[arg-type]

        slope = np.hypot(level(0.5, 0) - level(-0.5, 0), level(0, 0.5) - level(0, -0.5))
        best = np.maximum(best, (level(0, 0) - press.sink * press.depth) / np.maximum(slope, 1e-3) * SCALE)
    return best


def expected_errors(depth: list[Values], moved: list[Values], rng: np.random.Generator) -> Values:
    """Mean over the frames of the expected length of the mean flow's error, px, for each of `SIGMA`.

    depth : (n,) each, px, of the visible markers. moved : (n, 2) each, their displacements, px. The outline
    is off by an independent normal error at each marker, without a bias; positions are exact.
    """
    errors = np.zeros(len(SIGMA))
    for place, sigma in enumerate(SIGMA):
        frames = []
        for inside, displacement in zip(depth, moved, strict=True):
            truth = displacement[inside > 0].mean(axis=0)
            near = np.abs(inside) < 5 * sigma
            said = np.tile(inside > 0, (DRAWS, 1))
            said[:, near] = inside[near] + sigma * rng.standard_normal((DRAWS, int(near.sum()))) > 0
            count = said.sum(axis=1)
            mean = said[count > 0].astype(np.float64) @ displacement / count[count > 0, None]
            if len(mean):
                frames.append(float(np.hypot(*(mean - truth).T).mean()))
        errors[place] = np.mean(frames)
    return errors


def curves(say: Callable[[str], None]) -> list[Curve]:
    """Render the nominal scenes, run the default pipeline on them, and compute what could be expected."""
    rng = np.random.default_rng(1)
    found = []
    cases = tuple(case for case in FULL if case.label in NOMINAL)
    with tempfile.TemporaryDirectory() as folder:
        for rendered in render_all(cases, Path(folder)):
            pipeline = LockstepPipeline(on_recording(load_pipeline(PIPELINE), rendered.path), None)
            score, off, index = FlowScore(), [], None
            depths, moves = [], []
            for outcome in iter(pipeline.step, None):
                number, mapping, markers = outcome.frame.seq, outcome.mapping, outcome.markers
                if mapping is None or markers is None:
                    continue
                truth = rendered.truths(mapping)[number]
                if index is None:
                    index = metrics.match(markers.origin, truth.origin, metrics.grid_pitch(truth.origin) / 2)
                score.add(outcome.flow, truth)
                depth = true_depth(rendered.scene, number)
                if not (depth[truth.visible] > 0).any():
                    continue
                depths.append(depth[truth.visible])
                moves.append((truth.position - truth.origin)[truth.visible])
                mask = outcome.contact_mask
                if mask is not None and rendered.deep(number) and markers.radius is not None:
                    hidden = markers.radius + HIDDEN
                    seen = outline_depth(markers.position[index], mask, hidden, hidden + 1)
                    near = truth.visible & (index >= 0) & (np.abs(depth) < NEAR) & np.isfinite(seen)
                    off.extend((seen - depth)[near].tolist())
            if not depths:
                continue
            measured, certain = (score.errors().get(key) for key in ("flow_error", "flow_decided"))
            sigma = float(np.std(off)) if len(off) >= 20 else None
            curve = Curve(rendered.case.label, expected_errors(depths, moves, rng), measured, certain, sigma)
            found.append(curve)
            say(row(curve, float(np.mean(off)) if off else math.nan))
    return found


def row(curve: Curve, bias: float) -> str:
    """One line of the table."""
    cells = [f"{curve.expected[SIGMA.index(sigma)]:.3f}" for sigma in (0.2, 0.5, 1.0)]
    enough = [sigma for sigma, error in zip(SIGMA, curve.expected, strict=True) if error <= TARGET]
    spread = "-" if curve.sigma is None else f"{curve.sigma:.2f} ({bias:+.2f})"
    measured = ["-" if error is None else f"{error:.3f}" for error in (curve.measured, curve.decided)]
    return f"| {curve.name} | " + " | ".join([*cells, f"{max(enough):g}", spread, *measured]) + " |"


def picture(found: list[Curve]) -> str:
    """An SVG: expected error over the outline's, one line a scene; what was measured as dots."""
    width, height, left, top, right, bottom = 900, 420, 70, 20, 150, 50
    high = 0.8

    def x(sigma: float) -> float:
        return left + sigma / SIGMA[-1] * (width - left - right)

    def y(error: float) -> float:
        return top + (1 - min(error, high) / high) * (height - top - bottom)

    rows = [
        f'<rect x="{left}" y="{top}" width="{width - left - right}" height="{height - top - bottom}" '
        'fill="none" stroke="#aaa"/>',
        f'<path d="M{left} {y(TARGET):.1f}H{width - right}" stroke="#666" stroke-dasharray="5 4"/>',
        f'<text x="{left + 6}" y="{y(TARGET) - 5:.1f}" fill="#666">target</text>',
    ]
    rows += [
        f'<text x="{x(tick):.0f}" y="{height - bottom + 16}" text-anchor="middle">{tick:g}</text>'
        for tick in (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5)
    ]
    rows += [
        f'<text x="{left - 6}" y="{y(tick) + 4:.0f}" text-anchor="end">{tick:g}</text>'
        for tick in (0.0, 0.2, 0.4, 0.6, 0.8)
    ]
    order = sorted(found, key=lambda curve: -curve.expected[-1])
    for place, curve in enumerate(order):
        colour = COLOURS[place % len(COLOURS)]
        points = " ".join(f"{x(s):.1f},{y(float(e)):.1f}" for s, e in zip(SIGMA, curve.expected, strict=True))
        rows.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.8"/>')
        legend = top + 10 + 20 * place
        rows.append(
            f'<path d="M{width - right + 12} {legend}h22" stroke="{colour}" stroke-width="3"/>'
            f'<text x="{width - right + 40}" y="{legend + 4}">{curve.name}</text>'
        )
        if curve.sigma is not None and curve.measured is not None:
            dot = f'cx="{x(min(curve.sigma, SIGMA[-1])):.1f}" cy="{y(curve.measured):.1f}"'
            rows.append(f'<circle {dot} r="5" fill="{colour}" stroke="#fff"/>')
    middle = (left + width - right) / 2
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" font-family="sans-serif" '
        'font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
        + "\n".join(rows)
        + f'<text x="{middle}" y="{height - 12}" text-anchor="middle">error of the outline at the markers, '
        "standard deviation, px (dots: the default pipeline)</text>"
        f'<text transform="translate(18 {(top + height - bottom) / 2}) rotate(-90)" text-anchor="middle">'
        "error of the mean flow, mean, px</text></svg>\n"
    )


if __name__ == "__main__":
    cv2.setNumThreads(1)
    Path(__file__).with_name("flow-limits.svg").write_text(picture(curves(print)), encoding="utf-8")
