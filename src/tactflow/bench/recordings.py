"""Real recordings with labels: what can be said without knowing the whole truth.

`wedge_ball` has hand-labelled centres, `wedge_grasp` the grip's force, `wedge_roll` only the knowledge that
its 140 dots are printed on one continuous gel.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import gels, metrics
from tactflow.bench.lockstep import Outcome
from tactflow.bench.methods import CLASSIC, fill_times
from tactflow.bench.pipelines import on_recording, take_turns
from tactflow.bench.results import RECORDING, Measurement
from tactflow.bench.timing import CopyUnit
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.vision.types import MarkerStatus

CONTACT_FORCE = 0.75
"""Grip force from which on there is contact, N; docs/contact-limits.md shows what hangs on it."""

WEDGE_DOTS = 140
"""Dots printed on the Wedge's gel: 10 x 14."""

RECTIFY = {
    "from": [[33, 58], [208, 61], [56, 250], [185, 244]],
    "to": [[0, 0], [240, 0], [0, 320], [240, 320]],
    "size": [240, 320],
}
"""The gel's corners in the picture of the Wedge, and the rectangle they belong to."""

_MARKER_STAGES = frozenset({"tracker", "flow_in_mask", "visualize"})
"""Ids of the stages that need markers."""

Step = Callable[[], None]


def measure_recordings(
    pipelines: Mapping[str, Pipeline],
    markerless: Mapping[str, Pipeline],
    data: Path,
    scratch: Path,
    unit: CopyUnit,
    step: Step,
) -> Iterator[list[Measurement]]:
    """Run on every recording of a folder that is known here; unknown ones are left alone.

    Parameters
    ----------
    pipelines : for sensors with markers; their preprocessing is replaced by the Wedge's rectification.
    markerless : for sensors without. `CLASSIC` is the yardstick in both.
    data : folder of recordings. scratch : for temporary files. step : called after each frame.

    Raises
    ------
    ConfigError
        If the folder holds none of the known recordings.
    """
    check(data)
    if (data / "wedge_ball" / "labels.csv").exists():
        yield _ball(pipelines, data / "wedge_ball", scratch, unit, step)
    if (data / "wedge_roll").is_dir():
        yield _roll(pipelines, data / "wedge_roll", scratch, unit, step)
    grasps = sorted((data / "wedge_grasp").glob("*.csv"))
    if grasps:
        yield _grasps(markerless, grasps, scratch, unit, step)


def check(data: Path) -> None:
    """Find out before a long run that there is nothing to measure.

    Raises
    ------
    ConfigError
        If the folder holds none of the known recordings.
    """
    known = ("wedge_ball", "wedge_roll", "wedge_grasp", gels.FOLDER)
    if not any((data / name).is_dir() for name in known):
        raise ConfigError(f"--data {data}: required a folder with one of {', '.join(known)} in it")


def frame_count(data: Path) -> int:
    """How many frames `measure_recordings` will look at, for a progress display."""
    still = len(list((data / "wedge_ball").glob("*.jpg"))) + len(list((data / "wedge_roll").glob("*.jpg")))
    return still + sum(len(_forces(path)) for path in (data / "wedge_grasp").glob("*.csv"))


def rectified(pipeline: Pipeline) -> Pipeline:
    """The same pipeline with the Wedge's rectification as its only preprocessing."""
    nodes = {}
    for node in pipeline.nodes.values():
        if node.id == "preprocess":
            node = replace(node, params=node.component.params.model_validate({"homography": RECTIFY}))
        nodes[node.id] = node
    return replace(pipeline, nodes=nodes)


def without_markers(pipeline: Pipeline) -> Pipeline:
    """The same pipeline without the stages that need markers to be there."""
    gone = {node.id for node in pipeline.nodes.values() if node.id in _MARKER_STAGES}
    return replace(pipeline, nodes={i: node for i, node in pipeline.nodes.items() if i not in gone})


def stack(files: list[Path], scratch: Path) -> Path:
    """Images as one `.npy` recording, so that decoding is not part of the time."""
    path = scratch / "recording.npy"
    images = [cv2.imread(str(file), cv2.IMREAD_COLOR) for file in files]
    missing = [file.name for file, image in zip(files, images, strict=True) if image is None]
    if missing:
        raise ConfigError(f"--data: cannot read {', '.join(missing[:3])} in {files[0].parent}")
    np.save(path, np.stack([np.asarray(image) for image in images]))
    return path


def _run(
    pipelines: Mapping[str, Pipeline],
    scene: str,
    recording: Path,
    scratch: Path,
    unit: CopyUnit,
    step: Step,
    see: Callable[[str, Outcome], str],
    frames: int,
) -> dict[str, Measurement]:
    ready = {name: on_recording(pipeline, recording) for name, pipeline in pipelines.items()}
    times, failures = take_turns(ready, scratch, unit, see, step)
    made = {}
    for name in pipelines:
        made[name] = Measurement("pipeline", name, RECORDING + scene, frames=frames)
        made[name].failure = failures.get(name)
        if name not in failures:
            fill_times(made[name], times.samples[name], unit, times.samples.get(CLASSIC))
            made[name].stages_ms = times.stages.get(name, {})
    return made


def _ball(
    pipelines: Mapping[str, Pipeline], folder: Path, scratch: Path, unit: CopyUnit, step: Step
) -> list[Measurement]:
    with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    labels = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    recording = stack([folder / "reference.jpg", *(folder / row["file"] for row in rows)], scratch)
    centers: dict[str, NDArray[np.float64]] = {name: np.full((len(rows), 2), np.nan) for name in pipelines}

    def see(name: str, outcome: Outcome) -> str:
        if outcome.contact is not None and outcome.frame.seq > 0:
            centers[name][outcome.frame.seq - 1] = outcome.contact.center
        return "contact"

    ready = {name: rectified(pipeline) for name, pipeline in pipelines.items()}
    made = _run(ready, "wedge_ball", recording, scratch, unit, step, see, len(rows))
    for name, measurement in made.items():
        if measurement.failure is None:
            measurement.errors = label_errors(centers[name], labels)
    return list(made.values())


def label_errors(centers: NDArray[np.float64], labels: NDArray[np.float64]) -> dict[str, float]:
    """Found centres against hand labels.

    Parameters
    ----------
    centers : (N, 2) float64, px; NaN where no contact was found. labels : (N, 2) float64, px.

    Returns
    -------
    Quantities; distances are taken after the median offset, which depends on what the labeller took for the
    contact outline's middle.
    """
    found = np.isfinite(centers).all(axis=1)
    errors = {"found_percent": 100.0 * float(np.mean(found))}
    if found.any():
        offset = centers[found] - labels[found]
        offset -= np.median(offset, axis=0)
        distance = np.hypot(offset[:, 0], offset[:, 1])
        errors["label_center_p50"] = float(np.median(distance))
        errors["label_center_p95"] = float(np.percentile(distance, 95))
    return errors


def _roll(
    pipelines: Mapping[str, Pipeline], folder: Path, scratch: Path, unit: CopyUnit, step: Step
) -> list[Measurement]:
    files = sorted(folder.glob("*.jpg"))
    recording = stack(files, scratch)
    tallies = {name: IdentityTally() for name in pipelines}

    def see(name: str, outcome: Outcome) -> str:
        if outcome.markers is not None and outcome.frame.seq > 0:
            markers = outcome.markers
            tallies[name].add(markers.origin, markers.position, markers.status == MarkerStatus.LOST)
        return "contact"

    ready = {name: rectified(pipeline) for name, pipeline in pipelines.items()}
    made = _run(ready, "wedge_roll", recording, scratch, unit, step, see, len(files))
    for name, measurement in made.items():
        if measurement.failure is None:
            measurement.errors = tallies[name].errors()
    return list(made.values())


class IdentityTally:
    """Signs of wrong identities that need no truth: shared dots, and flow that tears the gel."""

    def __init__(self) -> None:
        self._pairs: NDArray[np.int64] | None = None
        self._pitch = 0.0
        self._count = 0
        self._frames = 0
        self._shared = 0
        self._jumps = 0
        self._torn = 0
        self._lost = 0

    def add(
        self, origin: NDArray[np.float64], position: NDArray[np.float64], lost: NDArray[np.bool_]
    ) -> None:
        """Count one frame: (N, 2), (N, 2) px, (N,)."""
        self._frames += 1
        self._count = len(origin)
        if len(origin) < 2:
            return
        if self._pairs is None:
            self._pitch = metrics.grid_pitch(origin)
            # Not the diagonal ones: with them, a steep but smooth edge of a moving region looks torn.
            self._pairs = metrics.neighbours(origin)
        jumps = metrics.flow_jumps(position - origin, ~lost, self._pairs, self._pitch)
        self._shared += metrics.shared_dots(position, ~lost, self._pitch)
        self._jumps += jumps
        self._torn += jumps > 0
        self._lost += int(np.count_nonzero(lost))

    def errors(self) -> dict[str, float]:
        """Quantity -> value."""
        if not self._frames:
            return {"markers_short": float(WEDGE_DOTS)}
        return {
            "markers_short": float(abs(WEDGE_DOTS - self._count)),
            "shared_dots": self._shared / self._frames,
            "flow_jumps": self._jumps / self._frames,
            "frames_with_jumps": 100.0 * self._torn / self._frames,
            "lost_share": 100.0 * self._lost / max(1, self._count * self._frames),
        }


def _forces(path: Path) -> NDArray[np.float64]:
    with path.open(newline="", encoding="utf-8") as file:
        return np.array([float(row["force_n"]) for row in csv.DictReader(file)])


def judged_by_force(force: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where there is contact, and which samples can be trusted to say so.

    Parameters
    ----------
    force : (N,) float64, N. A sample is a glitch where it and the median of the five around it lie on
        different sides of `CONTACT_FORCE`: a median keeps a step where it is, and removes one or two strays.

    Returns
    -------
    contact, trusted : (N,) bool.
    """
    padded = np.pad(force, 2, mode="edge")
    smooth = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    contact = smooth >= CONTACT_FORCE
    return contact, contact == (force >= CONTACT_FORCE)


def _grasps(
    pipelines: Mapping[str, Pipeline], files: list[Path], scratch: Path, unit: CopyUnit, step: Step
) -> list[Measurement]:
    total: dict[str, Measurement] = {}
    right = dict.fromkeys(pipelines, 0)
    judged = dict.fromkeys(pipelines, 0)
    for path in files:
        contact, trusted = judged_by_force(_forces(path))

        def see(
            name: str,
            outcome: Outcome,
            contact: NDArray[np.bool_] = contact,
            trusted: NDArray[np.bool_] = trusted,
        ) -> str:
            index = outcome.frame.seq
            if not 0 <= index < len(contact):
                return "idle"
            if trusted[index]:
                judged[name] += 1
                right[name] += (outcome.contact is not None) == bool(contact[index])
            return "contact" if contact[index] else "idle"

        made = _run(
            pipelines, "wedge_grasp", path.with_suffix(".avi"), scratch, unit, step, see, len(contact)
        )
        for name, measurement in made.items():
            before = total.setdefault(name, measurement)
            if before is not measurement:
                before.frames += measurement.frames
                before.failure = before.failure or measurement.failure
    for name, measurement in total.items():
        if measurement.failure is None and judged[name]:
            measurement.errors = {"force_right": 100.0 * right[name] / judged[name]}
    return list(total.values())
