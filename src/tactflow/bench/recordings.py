"""Real recordings of one sensor with labels: what can be said without knowing the whole truth.

`wedge_ball` has hand-labelled centres, `wedge_grasp` the grip's force, `wedge_roll` only the knowledge that
its 140 dots are printed on one continuous gel.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench import gels, metrics
from tactflow.bench.lockstep import TimedResult, on_recording, take_turns
from tactflow.bench.pipelines import PIPELINE
from tactflow.bench.quantities import Tally
from tactflow.bench.results import RECORDING, BenchResult
from tactflow.bench.timing import CopyUnit, Times
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

Judge = Callable[[Tally, TimedResult], str]
"""Adds the errors of one frame to a tally; returns the kind of frame."""


@dataclass(frozen=True, slots=True)
class Bench:
    """What measurements share. result : rows are added to it. unit : measured along the way.

    step : called with the number of frames that all pipelines have done. scratch : for temporary files.
    """

    result: BenchResult
    unit: CopyUnit
    step: Callable[[int], None]
    scratch: Path

    def run(self, pipelines: Mapping[str, Pipeline], scene: str, parts: Sequence[tuple[Path, Judge]]) -> None:
        """Run pipelines, in turns, on the parts of a recording, each with the function that judges it."""
        tallies = {name: Tally() for name in pipelines}
        times: dict[str, Times] = {name: defaultdict(list) for name in pipelines}
        frames: dict[str, int] = dict.fromkeys(pipelines, 0)
        for path, judge in parts:

            def see(name: str, found: TimedResult, judge: Judge = judge) -> str:
                frames[name] += 1
                return judge(tallies[name], found)

            ready = {name: on_recording(pipeline, path) for name, pipeline in pipelines.items()}
            measured, failures = take_turns(ready, see, unit=self.unit, step=self.step)
            for name, kinds in measured.items():
                for kind, samples in kinds.items():
                    times[name][kind] += samples
            self.result.failures |= {f"{PIPELINE}/{n}/{RECORDING}{scene}": why for n, why in failures.items()}
        for name, tally in tallies.items():
            errors = tally.errors()
            self.result.add(PIPELINE, name, RECORDING + scene, errors, times=times[name], frames=frames[name])


def measure_recordings(
    bench: Bench, marked: Mapping[str, Pipeline], bare: Mapping[str, Pipeline], data: Path
) -> None:
    """Run on every recording of a folder that is known here; unknown ones are left alone.

    marked : for sensors with markers; their preprocessing is replaced by the Wedge's rectification.
    bare : for sensors without. data : folder of recordings.
    """
    ready = {name: rectified(pipeline) for name, pipeline in marked.items()}
    if (data / "wedge_ball" / "labels.csv").exists():
        files, labels = labelled_presses(data / "wedge_ball")
        path = stack(files, bench.scratch)
        bench.run(ready, "wedge_ball", [(path, lambda t, r: _press(t, r, labels))])
    if (data / "wedge_roll").is_dir():
        path = stack(sorted((data / "wedge_roll").glob("*.jpg")), bench.scratch)
        bench.run(ready, "wedge_roll", [(path, _roll)])
    parts = []
    for path in sorted((data / "wedge_grasp").glob("*.csv")):
        contact, trusted = judged_by_force(_forces(path))
        parts.append((path.with_suffix(".avi"), _grasp_judge(contact, trusted)))
    if parts:
        bench.run(bare, "wedge_grasp", parts)


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
    node = pipeline.nodes["preprocess"]
    changed = replace(node, params=node.component.params.model_validate({"homography": RECTIFY}))
    return replace(pipeline, nodes={**pipeline.nodes, "preprocess": changed})


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


def _press(tally: Tally, result: TimedResult, labels: NDArray[np.float64]) -> str:
    """Compare a centre with its label, (N, 2) px for the frames from 1 on."""
    if result.frame.seq > 0:
        tally.percent(found_percent=result.contact is not None)
        if result.contact is not None:
            offset = np.subtract(result.contact.center, labels[result.frame.seq - 1])
            tally.add(label_center_p50=offset, label_center_p95=offset)
    return "contact"


def _roll(tally: Tally, result: TimedResult) -> str:
    if result.frame.seq > 0 and result.markers is not None:
        add_identity_signs(tally, result.markers)
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


def _grasp_judge(contact: NDArray[np.bool_], trusted: NDArray[np.bool_]) -> Judge:
    def judge(tally: Tally, result: TimedResult) -> str:
        index = result.frame.seq
        if index >= len(contact):
            return "idle"
        if trusted[index]:
            tally.percent(force_right=(result.contact is not None) == bool(contact[index]))
        return "contact" if contact[index] else "idle"

    return judge
