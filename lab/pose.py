"""Judge poses: on simulated motions, on real imprints that are moved, and on the edge of a cube.

    python -m lab.pose [--data ../shared/data] [--keep FOLDER]

Columns: frames; lost; RMS error of translation (mm) and rotation (degrees), of those of the six numbers whose
stated error is below `SEEN`; seen, share of these, %; cover, share of all errors within one and within two
stated standard errors, %; ms, median thread time of the tracker alone.
"""

from __future__ import annotations

import argparse
import json
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from lab.depth import EDGE, SETS, Balls, scale_of, sessions_of
from tactflow.calibration import KINDS
from tactflow.calibration.file import Calibration
from tactflow.calibration.presses import Session
from tactflow.sim import shapes
from tactflow.sim.recipes import SCENES
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.pose.align import align
from tactflow.vision.pose.imprint import imprint_of, template_of
from tactflow.vision.pose.rigid import inverse, rigid, vector
from tactflow.vision.pose.tracker import PoseTracker
from tactflow.vision.types import Pose, Scale

Motion = NDArray[np.float64]
SEEN = np.repeat([0.3, 5.0], 3)
"""Standard errors, mm and degrees, above which a number counts as unknown."""
FRAMES = 300
NOISE = 1.0
"""Camera noise that is added to a picture that was moved, grey levels."""
MOVES = ((2.3, -1.4, 1.5), (4.1, 2.2, -3.0), (-5.5, 3.7, 6.0))
"""Shifts, px, and turns, degrees, of real imprints."""
SCENARIOS = {
    "ball pressed": "press",
    "ball rolled": "roll",
    "ball slid": "slide",
    "bumpy ball rolled": "tumble",
    "box turned": "twist",
    "coin pressed": "coin",
    "coin rocked": "rock",
    "coin slid": "scrape",
    "coin rocked, no dots": "rock&markers=none",
    "bumpy ball, no dots": "tumble&markers=none",
    "ball slid, no dots": "slide&markers=none",
}


@dataclass
class Row:
    """Values of a row of the table."""

    errors: list[Any] = field(default_factory=list)
    stated: list[Any] = field(default_factory=list)
    times: list[float] = field(default_factory=list)
    lost: int = 0

    def add(self, pose: Pose, true: Motion) -> None:
        """Compare a pose with the true motion (4, 4) about its centre."""
        found = matrix(pose)
        turn, _ = cv2.Rodrigues(true[:3, :3] @ found[:3, :3].T)
        self.errors.append([*(true[:3, 3] - found[:3, 3]), *np.degrees(turn.ravel())])
        self.stated.append(pose.stderr)

    def __str__(self) -> str:
        errors, stated = np.array(self.errors), np.array(self.stated)
        seen = stated < SEEN
        rms = [
            np.sqrt(np.mean(errors[:, part][seen[:, part]] ** 2)) if seen[:, part].any() else np.nan
            for part in (slice(3), slice(3, 6))
        ]
        one, two = (100 * np.mean(abs(errors) < k * stated) for k in (1, 2))
        return (
            f"{len(errors):6d} {self.lost:5d} {rms[0]:8.3f} {rms[1]:7.2f} {100 * seen.mean():6.0f}"
            f"{one:6.0f} {two:4.0f} {1000 * np.median(self.times):7.2f}"
        )


def matrix(pose: Pose) -> Motion:
    """(4, 4) of a pose."""
    return rigid(np.array([*pose.translation, *np.radians(pose.rotation)]))


def simulated(query: str, calibration: Path, keep: Path) -> Row:
    """Track a simulated scene."""
    name, _, more = query.partition("&")
    recipe = SCENES[name]
    if name == "roll":
        # What rolls and sticks does not press the gel apart; and a paraboloid is no ball.
        assert recipe.programme is not None
        programme = replace(recipe.programme, dilation=0.0, indenters=(shapes.ball,))
        SCENES[name] = recipe._replace(programme=programme)
    spec = f"{name}?frames={FRAMES}&{more}".rstrip("&")
    kept = keep / f"{query}.pickle"
    if not kept.exists():
        kept.write_bytes(pickle.dumps(list(inputs(spec, calibration))))
    row = Row()
    tracker: PoseTracker | None = None
    start: Motion | None = None
    for seq, scale, depth, mask, flow, slipping, true in pickle.loads(kept.read_bytes()):
        tracker = tracker or PoseTracker(scale)
        if depth is None:
            tracker.reset()
            continue
        before = time.thread_time()
        pose = tracker(seq, depth, mask, flow, slipping)
        row.times.append(time.thread_time() - before)
        row.lost += pose is not None and pose.status == "lost"
        if pose is None or pose.status == "lost" or true is None:
            continue
        center = rigid(np.array([*pose.center, 0.0, 0.0, 0.0]))
        if pose.since == seq or start is None:
            start = true
        else:
            row.add(pose, inverse(center) @ true @ inverse(start) @ center)
    return row


def inputs(spec: str, calibration: Path) -> Iterator[tuple[Any, ...]]:
    """What the tracker gets from each frame of a scene, and the true pose (4, 4)."""
    scene = tactflow.open_scene(spec)
    pipeline = "markerless" if "markers=none" in spec else None
    settings: dict[str, Any] = {"calibration": str(calibration)}
    if pipeline is None:
        settings["stages.slip"] = {}
    mapping = None
    for result in tactflow.stream(pipeline, source=f"sim:{spec}", settings=settings):
        # One object for all frames, by which the scene remembers its pixels: each result has a copy.
        mapping = mapping or result["mapping"]
        pose = scene.truth(result.seq, mapping).pose
        true = None
        if pose is not None:
            true = np.eye(4)
            true[:3, :3], true[:3, 3] = pose
        mask = result.contact_mask
        depth = result.depth if mask is not None and mask.any() else None
        yield result.seq, result.scale, depth, mask, result.field, result.value("slipping") is True, true


def moved(session: Session, balls: Balls, base: Calibration, turns: bool) -> Row:
    """Track real imprints that are moved: pictures that are shifted, or heights that are turned as well."""
    scale, rest, row = scale_of(balls, session), Rest(session.untouched), Row()
    assert base.slopes is not None
    assert base.photometric is not None
    surface = Surface(base.slopes, scale, base.photometric.errors())
    noise = np.random.default_rng(1)
    for press in session.presses:
        tracker = PoseTracker(scale)
        depth = surface.depth(press.image, rest, press.mask)
        if tracker(0, depth, press.mask) is None:
            continue
        for number, (x, y, turn) in enumerate(MOVES, 1):
            rotation = cv2.getRotationMatrix2D(press.center, -turn if turns else 0.0, 1.0)
            warp = np.asarray(rotation, np.float64)
            warp[:, 2] += np.array([x, y])
            inside = warped(press.mask.astype(np.float32), warp) > 127
            mask = np.where(inside, 255, 0).astype(np.uint8)
            if turns:
                now = replace(depth, heights=warped(depth.heights, warp))
            else:
                change = warped(press.image.astype(np.float32) - session.untouched, warp)
                change += noise.normal(0, NOISE, change.shape)
                image = np.clip(np.rint(session.untouched + change), 0, 255).astype(np.uint8)
                now = surface.depth(image, rest, mask)
            before = time.thread_time()
            pose = tracker(number, now, mask)
            row.times.append(time.thread_time() - before)
            if pose is None or pose.status == "lost":
                row.lost += 1
                break
            row.add(pose, true_motion(pose, warp, scale))
    return row


def warped(picture: NDArray[np.float32], warp: NDArray[np.float64]) -> NDArray[np.float32]:
    """A picture after an affine map (2, 3), px."""
    size = (picture.shape[1], picture.shape[0])
    return np.asarray(cv2.warpAffine(picture, warp, size, flags=cv2.INTER_CUBIC), np.float32)


def true_motion(pose: Pose, warp: NDArray[np.float64], scale: Scale) -> Motion:
    """(4, 4), mm, about the centre of a pose, of an affine map of the picture."""
    center = np.array(pose.center[:2]) / scale.x + scale.origin
    motion = np.eye(4)
    motion[:2, :2] = warp[:, :2]
    motion[:2, 3] = (warp[:, :2] @ center + warp[:, 2] - center) * scale.x
    return motion


def edges(session: Session, names: list[str], base: Calibration, data: Path) -> str:
    """The turn between every two presses of the edge of a cube, against the labels of its direction."""
    labels = json.loads((data / EDGE.folder / "labels.json").read_text())
    assert base.slopes is not None
    assert base.photometric is not None
    scale, rest = scale_of(EDGE, session), Rest(session.untouched)
    surface = Surface(base.slopes, scale, base.photometric.errors())
    seen = []
    for press, name in zip(session.presses, names, strict=True):
        label = labels.get(Path(name).stem)
        depth = surface.depth(press.image, rest, press.mask)
        imprint = imprint_of(depth.heights, press.mask, scale, 0.1)
        if label is not None and imprint is not None:
            seen.append((imprint, label["line_angle"], np.array(label["line_center"]) * scale.x))
    off, across = [], []
    for first, angle, place in seen:
        template = template_of(first)
        for other, now_angle, now_place in seen:
            if other is first:
                continue
            shift = template_of(other).center - template.center
            found = align(template, other, rigid(np.array([*shift, 0.0, 0.0, 0.0])), None)
            if found is None:
                continue
            off.append(np.degrees(vector(found.motion)[5]) - (now_angle - angle))
            origin = template.center[:2] + np.array(scale.origin) * scale.x
            end = found.motion[:2, :2] @ (place - origin) + found.motion[:2, 3] + origin - now_place
            slant = np.radians(now_angle)
            across.append(end[1] * np.cos(slant) - end[0] * np.sin(slant))
    return (
        f"edge of a cube, {len(off)} pairs of presses: turn off by "
        f"{np.sqrt(np.mean(np.square(off))):.1f} degrees RMS, "
        f"median {np.median(np.abs(off)):.1f}; place across the edge by {np.median(np.abs(across)):.2f} mm"
    )


def simulated_calibration(folder: Path) -> Path:
    """The calibration file of the simulated sensor in a folder; created if it is missing."""
    folder.mkdir(parents=True, exist_ok=True)
    calibration = folder / "calibration" / "main.yaml"
    if not calibration.exists():
        command = [sys.executable, "-m", "tactflow", "calibrate", "--from", "sim:ball?frames=600"]
        command += ["--pitch", "1.724", "--ball-radius", "2.375"]
        subprocess.run(command, cwd=folder, check=True)
    return calibration


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="judge the pose of objects")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--keep", type=Path, help="folder with the inputs of an earlier run")
    parser.add_argument("--only", help="rows whose name has this in it")
    args = parser.parse_args()
    keep = args.keep or Path(tempfile.mkdtemp())
    calibration = simulated_calibration(keep)
    print(f"{'':24} frames  lost      mm     deg   seen  cover         ms")
    for label, query in SCENARIOS.items():
        if not args.only or args.only in label:
            print(f"{label:24} {simulated(query, calibration, keep)}", flush=True)
    names = [name for name, balls in SETS.items() if balls.kind or name == "gelslam"]
    sessions = sessions_of([*names, "edge"], args.data, keep)
    base = Calibration.load(KINDS / "mini.yaml")
    for name in (*names, "edge"):
        balls = EDGE if name == "edge" else SETS[name]
        for turns, label in ((False, f"{name}, shifted"), (True, f"{name}, turned")):
            if not args.only or args.only in label:
                print(f"{label:24} {moved(sessions[name][0], balls, base, turns)}", flush=True)
    print(edges(*sessions["edge"], base, args.data))


if __name__ == "__main__":
    main()
