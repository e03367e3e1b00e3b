"""Judge maps of objects on simulated recordings: errors of the surface, and drift with and without loops.

    python -m lab.map [--keep FOLDER] [--only NAME]

Columns: frames; keyframes; loops that were closed; points; twice, without and with loop closure: error of the
surface against the true object, median and 90 %, mm, in the axes of the keyframe with the largest patch, and
the share of these errors within one and two stated standard errors, %; twice, drift: RMS over the keyframes,
of the middle of a patch, mm, and of the turn, degrees; ms, thread time of mapping a frame, without what the
pipeline takes.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
import time
from collections import Counter
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

import tactflow
from lab.pose import inputs, simulated_calibration
from tactflow.plugins.map.closure import mapped
from tactflow.plugins.map.graph import Graph
from tactflow.plugins.map.joining import bridge, joined
from tactflow.plugins.map.keyframes import Contact, Touch, contacts_of, overlap
from tactflow.plugins.map.surface import Points, merged
from tactflow.sim.gel import MM_PER_PX, reached
from tactflow.vision.pose.rigid import inverse, vector

FRAMES = 300
SCENARIOS = {
    "medal larger than the gel, slid": "medal",
    "the same, lifted three times": "lifts",
    "bumpy ball, rolled around": "orbit",
    "the same, no dots": "orbit&markers=none",
    "threaded rod, rolled around": "thread",
    "coin, slid": "scrape&markers=none",
}
OBJECTS = ("lifts", "orbit&markers=none", "thread", "scrape&markers=none")
"""Recordings of different objects."""
PIECE_KEYFRAMES = 3
"""Keyframes of the parts of contacts that are joined."""
SHARED = 0.7
"""Share of a patch that another part shows, above which not joining them is a miss."""
WRONG_MM_RADIANS = np.repeat([0.3, 0.1], 3)
"""Error of the motion between parts that were joined, above which that is wrong."""
PROCESSED_MM = 2 * MM_PER_PX
"""Millimetres per processed pixel of the simulated sensor, whose pipelines halve the picture."""


class Recording(NamedTuple):
    """Frames of a simulated recording, with the true poses (4, 4), by number of the frame."""

    spec: str
    mapping: Any
    touches: list[Touch | None]
    true: dict[int, NDArray[np.float64]]


def recorded(query: str, calibration: Path, keep: Path) -> Recording:
    """A simulated recording."""
    name, _, more = query.partition("&")
    more = more or ("markers=none" if name in ("medal", "lifts") else "")
    spec = f"{name}?frames={FRAMES}&{more}".rstrip("&")
    kept = keep / f"{query}.pickle"
    if not kept.exists():
        kept.write_bytes(pickle.dumps(list(inputs(spec, calibration))))
    touches: list[Touch | None] = []
    true = {}
    for seq, scale, depth, mask, field, slipping, pose in pickle.loads(kept.read_bytes()):
        touches.append(None if depth is None else Touch(seq, scale, depth, mask, field, slipping))
        if pose is not None:
            true[seq] = pose
    first = next(tactflow.stream("markerless", source=f"sim:{spec}", settings={"sinks": {}}, max_frames=1))
    return Recording(spec, first["mapping"], touches, true)


def surface_errors(points: Points, contact: Contact, graph: Graph, recording: Recording) -> Any:
    """(N,), mm: distance of each point from the true surface, along the normal.

    It is measured in the keyframe in which the point truly was deepest.
    """
    scene = tactflow.open_scene(recording.spec)
    seqs = [keyframe.seq for keyframe in contact.keyframes]
    back = inverse(recording.true[seqs[graph.anchor]])
    moved = [recording.true[seq] @ back for seq in seqs]
    heights = np.array([points.place @ motion[2, :3] + motion[2, 3] for motion in moved])
    deepest, errors = heights.argmin(axis=0), np.zeros(len(points))
    for index, (seq, motion) in enumerate(zip(seqs, moved, strict=True)):
        those = np.flatnonzero(deepest == index)
        place = points.place[those] @ motion[:3, :3].T + motion[:3, 3]
        normal = points.normal[those] @ motion[:3, :3].T
        pixels = place[:, :2] / PROCESSED_MM + (np.array(recording.mapping.size) - 1) / 2
        gel = scene.camera.to_gel(recording.mapping.to_raw(pixels)).astype(np.float32)
        depth = reached(scene.presses(seq)[0], gel[:, 0], gel[:, 1]) * MM_PER_PX
        errors[those] = -(place[:, 2] + depth) * normal[:, 2]
    return errors


def drift(contact: Contact, graph: Graph, recording: Recording) -> tuple[float, float]:
    """RMS errors of the keyframes: of the middle of their patches, mm, and of their turns, degrees."""
    seqs = [keyframe.seq for keyframe in contact.keyframes]
    back = inverse(recording.true[seqs[graph.anchor]])
    away, turns = [], []
    for keyframe, pose in zip(contact.keyframes, graph.poses, strict=True):
        error = recording.true[keyframe.seq] @ back @ inverse(pose)
        center = keyframe.template.center
        away.append(np.linalg.norm(error[:3, :3] @ center + error[:3, 3] - center))
        turns.append(np.degrees(np.linalg.norm(cv2.Rodrigues(error[:3, :3])[0])))
    return tuple(float(np.sqrt(np.mean(np.square(part)))) for part in (away, turns))  # type: ignore[return-value]


def judged(recording: Recording) -> str:
    """The columns of a row."""
    before = time.thread_time()
    contact, _ = joined(contacts_of(recording.touches))
    plain = mapped(contact.keyframes, contact.edges, loops=False)
    graph = mapped(contact.keyframes, contact.edges)
    points = merged(contact.keyframes, graph)
    spent = 1000 * (time.thread_time() - before) / contact.frames
    columns = [f"{contact.frames:6d} {len(contact.keyframes):5d} {len(graph.edges) - len(contact.edges):5d}"]
    columns.append(f"{len(points):7d}")
    for one in (plain, graph):
        surface = merged(contact.keyframes, one)
        errors = np.abs(surface_errors(surface, contact, one, recording))
        columns.append(f"{np.median(errors):8.3f} {np.quantile(errors, 0.9):6.3f}")
        columns += [f"{100 * np.mean(errors < k * surface.error):4.0f}" for k in (1, 2)]
    columns += ["{:8.2f} {:5.1f}".format(*drift(contact, one, recording)) for one in (plain, graph)]
    return " ".join([*columns, f"{spent:6.1f}"])


def pieces(recording: Recording) -> list[Contact]:
    """Parts of the contacts of a recording, a few keyframes each."""
    found = []
    for contact in contacts_of(recording.touches):
        for start in range(0, len(contact.keyframes) - PIECE_KEYFRAMES + 1, PIECE_KEYFRAMES):
            end = start + PIECE_KEYFRAMES
            edges = [
                edge._replace(before=edge.before - start, now=edge.now - start)
                for edge in contact.edges[start : end - 1]
            ]
            found.append(Contact(contact.keyframes[start:end], edges))
    return found


def judged_joins(recordings: dict[str, Recording]) -> str:
    """How often parts of contacts are joined rightly, wrongly, or not although they show the same."""
    parts = [(name, part) for name, recording in recordings.items() for part in pieces(recording)]
    counts: Counter[str] = Counter()
    for (name, one), (other_name, other) in combinations(parts, 2):
        edge = bridge(one, other)
        if name != other_name:
            counts["wrong, other object" if edge else "refused, other object"] += 1
            continue
        true = recordings[name].true
        motions = {
            (i, k): true[now.seq] @ inverse(true[before.seq])
            for i, before in enumerate(one.keyframes)
            for k, now in enumerate(other.keyframes)
        }
        if edge is None:
            shared = max(
                overlap(one.keyframes[i].imprint, other.keyframes[k].template, inverse(motion))
                for (i, k), motion in motions.items()
            )
            counts["missed" if shared > SHARED else "refused, another part"] += 1
            continue
        error = vector(motions[edge.before, edge.now] @ inverse(edge.motion))
        near = (np.abs(error) < WRONG_MM_RADIANS).all()
        counts["right" if near else "wrong, same object"] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="judge maps of objects")
    parser.add_argument("--keep", type=Path, help="folder with the inputs of an earlier run")
    parser.add_argument("--only", help="rows whose name has this in it")
    args = parser.parse_args()
    keep = args.keep or Path(tempfile.mkdtemp())
    calibration = simulated_calibration(keep)
    print(f"{'':32} frames keyfr. loops  points {'surface, without loops':26}{'with loops':26}{'drift':29}ms")
    for label, query in SCENARIOS.items():
        if not args.only or args.only in label:
            print(f"{label:32} {judged(recorded(query, calibration, keep))}", flush=True)
    if not args.only or args.only == "joins":
        kept = {query: recorded(query, calibration, keep) for query in OBJECTS}
        print(f"joins: {judged_joins(kept)}")


if __name__ == "__main__":
    main()
