"""Real recordings of one sensor with labels: what can be said without knowing the whole truth.

`wedge_ball` has hand-labelled centres, `wedge_grasp` the grip's force, `wedge_roll` only the knowledge that
its 140 dots are printed on one continuous gel.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import gels, metrics
from tactflow.bench.lockstep import TimedResult, with_params
from tactflow.bench.pipelines import Bench, Judge
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING
from tactflow.engine.errors import ConfigError
from tactflow.engine.graph import Pipeline
from tactflow.vision.types import Markers, MarkerStatus

CONTACT_FORCE = 0.75
"""Grip force from which on there is contact, N."""

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


def measure_recordings(
    bench: Bench, marked: Mapping[str, Pipeline], bare: Mapping[str, Pipeline], data: Path
) -> None:
    """Run on every recording of a folder that is known here; unknown ones are left alone.

    marked : for sensors with markers; their preprocessing is replaced by the Wedge's rectification.
    bare : for sensors without. data : folder of recordings.
    """
    ready = {
        name: with_params(pipeline, "preprocess", homography=RECTIFY) for name, pipeline in marked.items()
    }
    if (data / "wedge_ball" / "labels.csv").exists():
        files, labels = labelled_presses(data / "wedge_ball")
        ball = [(stack(files, bench.scratch), partial(PressJudge, labels))]
        bench.measure(ready, RECORDING + "wedge_ball", ball)
    if (data / "wedge_roll").is_dir():
        path = stack(sorted((data / "wedge_roll").glob("*.jpg")), bench.scratch)
        bench.measure(ready, RECORDING + "wedge_roll", [(path, RollJudge)])
    files = sorted((data / "wedge_grasp").glob("*.csv"))
    grasps = [(path.with_suffix(".avi"), partial(GraspJudge, _forces(path))) for path in files]
    if grasps:
        bench.measure(bare, RECORDING + "wedge_grasp", grasps)


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


def without_markers(pipeline: Pipeline) -> Pipeline:
    """The same pipeline without the stages that need markers to be there."""
    nodes = {name: node for name, node in pipeline.nodes.items() if name not in _MARKER_STAGES}
    return replace(pipeline, nodes=nodes)


def stack(files: Sequence[Path], scratch: Path) -> Path:
    """Images as one `.npy` recording."""
    path = scratch / "recording.npy"
    images = [cv2.imread(str(file), cv2.IMREAD_COLOR) for file in files]
    missing = [file.name for file, image in zip(files, images, strict=True) if image is None]
    if missing:
        raise ConfigError(f"--data: cannot read {', '.join(missing[:3])} in {files[0].parent}")
    np.save(path, np.stack([np.asarray(image) for image in images]))
    return path


def labelled_presses(folder: Path) -> tuple[list[Path], NDArray[np.float64]]:
    """Pictures of a ball's presses, the untouched gel first, and the hand-labelled centres (N, 2) px."""
    with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    labels = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    return [folder / "reference.jpg", *(folder / row["file"] for row in rows)], labels


class PressJudge(Judge):
    """Compares centres with labels, (N, 2) px of the frames from 1 on."""

    def __init__(self, labels: NDArray[np.float64], tally: Tally) -> None:
        super().__init__(tally)
        self._labels = labels

    def add(self, result: TimedResult) -> str:
        """Compare the centre in one frame."""
        if result.seq > 0:
            self.tally.percent(found_percent=result.contact is not None)
            if result.contact is not None:
                offset = np.subtract(result.contact.center, self._labels[result.seq - 1])
                self.tally.add(label_center_p50=offset, label_center_p95=offset)
        return "contact"


class RollJudge(Judge):
    """Looks for signs of wrong identities."""

    def add(self, result: TimedResult) -> str:
        """Count the signs in one frame."""
        if result.seq > 0 and result.markers is not None:
            add_identity_signs(self.tally, result.markers)
        return "contact"


def add_identity_signs(tally: Tally, markers: Markers) -> None:
    """Count signs of wrong identities that need no truth: shared dots, and flow that tears the gel."""
    lost = markers.status == MarkerStatus.LOST
    tally.percent(lost_share=lost)
    tally.add(markers_short=abs(WEDGE_DOTS - len(lost)))
    if len(lost) < 2:
        return
    jumps = metrics.flow_jumps(markers.origin, markers.displacement, ~lost)
    shared = metrics.shared_dots(markers.position, ~lost, metrics.dot_pitch(markers.origin))
    tally.add(shared_dots=shared, flow_jumps=jumps)
    tally.percent(frames_with_jumps=jumps > 0)


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


class GraspJudge(Judge):
    """Compares decisions with the grip's force, (N,) N."""

    def __init__(self, force: NDArray[np.float64], tally: Tally) -> None:
        super().__init__(tally)
        self._contact, self._trusted = judged_by_force(force)

    def add(self, result: TimedResult) -> str:
        """Compare the decision in one frame."""
        if result.seq >= len(self._contact):
            return "idle"
        contact = bool(self._contact[result.seq])
        if self._trusted[result.seq]:
            self.tally.percent(force_right=(result.contact is not None) == contact)
        return "contact" if contact else "idle"
