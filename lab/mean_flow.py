"""Judge the stated error of the mean flow, the outline's error in it.

    python -m lab.mean_flow [--data ../shared/data] [--scenes 150] [--seeds 1 2]

Real gels with dots, lab by lab, where the true mean is that inside the outline that a person drew; named
scenes of the simulator; and random gels far beyond any single sensor (`lab/wide.py`); all through the
pipeline `default`. Columns: RMS error of the mean flow, px; median of its stated error, px; share of errors
within one and within two stated errors, %; median overlap (IoU) of the contact's region with the true one;
frames. Random gels are split by that overlap: below 0.3 the contact was found somewhere else.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

import tactflow
from lab.judges.judge import OUTLINES, PLAIN, labelled
from lab.judges.label_file import load_labels
from lab.wide import WideScene, wide_scene
from tactflow.engine.errors import TactflowError
from tactflow.message.result import Result
from tactflow.sim import open_scene
from tactflow.system.terminal import show, table
from tactflow.tools.bench.metrics import filled_polygons, mask_iou
from tactflow.vision.arrays import Floats
from tactflow.vision.types import MarkerStatus

NAMED_SCENES = (
    *("press", "bright", "cable", "edge", "box", "ring", "screw", "two", "slide", "twist", "strong_shear"),
    *("worn", "dense", "irregular", "tilted", "noisy"),
)
FIRST_SEED = 1000
"""Seed of the first random gel: lower ones were trained on."""
MIN_OVERLAP = 0.3
"""Overlap below which the contact that was found is another one."""


class Comparison(NamedTuple):
    """error, stated : (2,) of the mean flow, px. overlap : of the region with the true one."""

    error: Floats
    stated: Floats
    overlap: float


def compare(result: Result, truth: Floats, contact: Floats) -> Comparison | None:
    """Compare a frame with the truth; None without a mean flow."""
    flow, mask = result.flow, result.contact_mask
    if mask is None or flow is None or flow.mean is None or flow.stderr is None:
        return None
    return Comparison(np.subtract(flow.mean, truth), np.array(flow.stderr), mask_iou(mask, contact))


def real(data: Path) -> dict[str, list[Comparison]]:
    """Labelled frames of each lab."""
    labels = [label for label in load_labels(OUTLINES) if label.outlines]
    labels = [label for label in labels if not label.recording.startswith(PLAIN)]
    labs: dict[str, list[Comparison]] = {}
    for label, result in labelled("default", labels, data):
        if result is None or result.field is None:
            continue
        mapping = result["mapping"]
        corners = [mapping.to_processed(outline) for outline in label.outlines or ()]
        drawn = np.where(filled_polygons(corners, mapping.size[::-1]) > 0, 255, 0).astype(np.uint8)
        motion = result.field.motion(drawn)
        comparison = motion and compare(result, np.array(motion.mean), drawn > 0)
        if comparison:
            labs.setdefault(label.lab, []).append(comparison)
    return labs


def named(name: str, seed: int) -> Iterator[Comparison]:
    """Frames of a scene; neighbouring ones err alike, so that every sixth will do."""
    spec = f"{name}?frames=60&seed={seed}"
    scene = open_scene(spec)
    pipeline = tactflow.load("default", source=f"sim:{spec}", settings={"sinks.view": None})
    for result in tactflow.stream(replace(pipeline, skipping=False)):
        if result.seq >= 0 and result.seq % 6 == 0:
            truth = scene.truth(result.seq, result["mapping"])
            comparison = truth.contact_flow and compare(
                result, np.array(truth.contact_flow), truth.contact_mask
            )
            yield from [comparison] if comparison else []


def random(scene: WideScene) -> Comparison | None:
    """A random gel with dots."""
    settings = {
        "stages.preprocess.rotate": 0,
        "stages.preprocess.downsample": 1,
        "stages.capture.settle": 0,
        "sinks.view": None,
    }
    pictures = np.stack([scene.reference, scene.reference, scene.picture])
    pipeline = tactflow.load("default", source=pictures, settings=settings)
    *_, result = tactflow.stream(replace(pipeline, skipping=False))
    height, width = scene.contact.shape
    rest = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
    limit = (width - 1, height - 1)
    now = np.clip(np.rint(rest + scene.shift), 0, limit).astype(int)
    inside = scene.contact[now[..., 1], now[..., 0]]
    if not inside.any() or result.markers is None:
        return None
    # Some cameras move against the gel, which is no error of the flow.
    tracked = result.markers.status == MarkerStatus.TRACKED
    origin = result.markers.origin[tracked]
    at = np.clip(np.rint(origin), 0, limit).astype(int)
    moved = result.markers.position[tracked] - origin - scene.shift[at[:, 1], at[:, 0]]
    if not len(moved):
        return None
    return compare(result, scene.shift[inside].mean(axis=0) + np.median(moved, axis=0), scene.contact)


def row(name: str, frames: list[Comparison]) -> list[str]:
    """The columns of a set."""
    error, stated = (np.array([comparison[column] for comparison in frames]) for column in (0, 1))
    within = [100 * np.mean(np.abs(error) < k * stated) for k in (1, 2)]
    return [
        name,
        f"{np.sqrt(np.mean(error**2)):.2f}",
        f"{np.median(stated):.2f}",
        f"{within[0]:.0f} {within[1]:.0f}",
        f"{np.median([comparison.overlap for comparison in frames]):.2f}",
        str(len(frames)),
    ]


def main() -> None:
    """Judge all kinds of scenes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenes", type=int, default=150, help="random gels with dots and a contact")
    parser.add_argument("--seeds", type=int, nargs="*", default=[1], help="of the named scenes")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    labs = real(args.data)
    sets = {
        name: [comparison for seed in args.seeds for comparison in named(name, seed)] for name in NAMED_SCENES
    }
    rows = [row(name, frames) for name, frames in (labs | sets).items() if frames]
    outlined = [comparison for frames in labs.values() for comparison in frames]
    known = [comparison for frames in sets.values() for comparison in frames]
    gels: list[Comparison] = []
    seed, tried = FIRST_SEED, 0
    while tried < args.scenes:
        scene, seed = wide_scene(seed), seed + 1
        if not scene.contact.any() or len(scene.origin) < 6:
            continue
        tried += 1
        try:
            comparison = random(scene)
        except TactflowError:
            # No dots were found.
            continue
        gels += [comparison] if comparison else []
    found = [comparison for comparison in gels if comparison.overlap > MIN_OVERLAP]
    rows += [row("all labs", outlined)] if outlined else []
    rows += [row("all named", known)] if known else []
    rows += [row("random, found", found), row("random, all", gels)]
    show(table([["scene", "error, px", "stated, px", "one, two", "overlap", "frames"], *rows]))


if __name__ == "__main__":
    main()
