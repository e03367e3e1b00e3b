"""Dots: where they are, and whether they are still themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import cv2
import numpy as np

from lab.judges import judge_dots
from lab.judges.label_file import load_labels
from lab.peers.common import (
    Calls,
    Numbers,
    Picture,
    Scene,
    Settings,
    another,
    combinations,
    errors_of,
    failed,
    on_scenes,
    recording,
    search,
    turns,
)
from lab.wide import WideScene, wide_scene
from tactflow import Markers, MarkerStatus, MarkerTracker
from tactflow.classic.functions import marker_center
from tactflow.classic.tracker import GridTracker
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.scenes import Case
from tactflow.tools.bench.score import MarkerScore
from tactflow.vision.arrays import Floats

FIRST_WIDE_SEED: Final = 2_000_000
"""Seed of the first random scene here."""
MEMORY_FRAMES: Final = 20
"""Frames for which trackpy remembers a particle that it does not see."""


# What a user of each package writes.


class Tactflow:
    """tactflow: no settings."""

    def __init__(self, reference: Picture) -> None:
        self.track = MarkerTracker(reference).track


class Classic:
    """The original script: its matcher, its constants."""

    def __init__(self, reference: Picture) -> None:
        self.track = GridTracker(reference).track


class Trackpy:
    """trackpy: locate in each picture, link to the particles of the first one."""

    def __init__(self, reference: Picture, **settings: Any) -> None:
        import trackpy

        trackpy.quiet()
        reach = settings.pop("search_range")
        self.settings, self.picture = settings, reference
        self.links = trackpy.link_iter(
            self.positions(), reach, memory=MEMORY_FRAMES, adaptive_stop=reach / 4, adaptive_step=0.9
        )
        next(self.links)
        self.origin = self.position = self.found

    def positions(self) -> Iterator[Floats]:
        """Centres in the present picture, whenever trackpy asks for the next ones."""
        while True:
            self.found = locate(self.picture, **self.settings)
            yield self.found

    def track(self, picture: Picture) -> Markers:
        """Where each particle of the first picture is now; lost where no particle was linked to it."""
        self.picture = picture
        particle = np.array(next(self.links)[1], int)
        known = particle < len(self.origin)
        self.position = self.position.copy()
        self.position[particle[known]] = self.found[known]
        status = np.full(len(self.origin), MarkerStatus.LOST, np.uint8)
        status[particle[known]] = MarkerStatus.TRACKED
        return Markers(self.origin, self.position, status, np.full(len(status), np.nan))


def locate(picture: Picture, **settings: Any) -> Floats:
    """trackpy: centres (N, 2) in one picture."""
    import trackpy

    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    return trackpy.locate(gray, characterize=False, **settings)[["x", "y"]].to_numpy()


class LucasKanade:
    """OpenCV: good features to track, followed by pyramids of Lucas and Kanade."""

    def __init__(self, reference: Picture, **settings: Any) -> None:
        self.window, self.chained = (settings.pop("window"),) * 2, settings.pop("chained")
        self.origin = corners(reference, **settings)
        self.position = self.origin
        self.before = cv2.cvtColor(reference, cv2.COLOR_BGR2GRAY)

    def track(self, picture: Picture) -> Markers:
        """Each feature from the frame before, or from the first one, beginning where it was last."""
        gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        start = self.position if self.chained else self.origin
        position, seen, _ = cv2.calcOpticalFlowPyrLK(
            self.before,
            gray,
            np.float32(start).reshape(-1, 1, 2),
            np.float32(self.position).reshape(-1, 1, 2),
            winSize=self.window,
            maxLevel=3,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        self.position = position[:, 0].astype(np.float64)
        self.before = gray if self.chained else self.before
        status = np.where(seen[:, 0], MarkerStatus.TRACKED, MarkerStatus.LOST).astype(np.uint8)
        return Markers(self.origin, self.position, status, np.full(len(status), np.nan))


def corners(picture: Picture, quality: float, distance: int) -> Floats:
    """OpenCV: good features (N, 2) in one picture."""
    gray = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    found = cv2.goodFeaturesToTrack(gray, 500, quality, distance)
    return np.zeros((0, 2)) if found is None else found[:, 0].astype(np.float64)


METHODS: Final[Mapping[str, Callable[..., Any]]] = {
    "tactflow": Tactflow,
    "classic script": Classic,
    "trackpy": Trackpy,
    "OpenCV Lucas-Kanade": LucasKanade,
}
FINDERS: Final[Mapping[str, Callable[..., Floats]]] = {
    "tactflow": judge_dots.find,
    "classic script": marker_center,
    "trackpy": locate,
    "OpenCV Lucas-Kanade": corners,
}
FINDING: Final[Mapping[str, Mapping[str, Sequence[Any]]]] = {
    "trackpy": {
        "diameter": (11, 7, 9, 13, 15, 17, 21),
        "minmass": (500, 100, 2000),
        "invert": (True, False),
    },
    "OpenCV Lucas-Kanade": {"quality": (0.1, 0.01, 0.3), "distance": (15, 8, 25)},
}
"""What is searched for each peer when it finds dots; the rest, when it follows them."""
FOLLOWING: Final[Mapping[str, Mapping[str, Sequence[Any]]]] = {
    "trackpy": {"search_range": (12, 8, 18, 26)},
    "OpenCV Lucas-Kanade": {"window": (21, 15, 31), "chained": (True, False)},
}
CHOICES: Final = {name: {**FINDING[name], **FOLLOWING[name]} for name in FINDING}


# How they are measured.


def badness(errors: Numbers) -> tuple[float, float]:
    """What the search minimises: dots that are lost or wrong, in whole percent; then the RMS error."""
    bad = errors["wrong_percent"] + errors["lost_percent"]
    return round(bad), errors.get("displacement_rms", np.inf)


def follow(
    scene: Scene, methods: Mapping[str, Settings], tallies: Mapping[str, Tally]
) -> dict[str, list[float]]:
    """Follow the dots of a recording. Where a method raises, all dots are lost."""
    _, pictures, truths = scene
    scores = {name: MarkerScore(tallies[name]) for name in methods}
    times: dict[str, list[float]] = {name: [] for name in methods}
    running = {}
    for name, settings in methods.items():
        try:
            running[name] = Calls(METHODS[name](pictures[0], **settings).track, pictures)
        except Exception as error:  # no dots, says the package
            failed(name, error)
            lose(tallies[name], truths)
    for name, index, markers, seconds in turns(running):
        if isinstance(markers, Exception):
            failed(name, markers)
            lose(tallies[name], truths[index : index + 1])
        else:
            scores[name].add(markers, truths[index])
            times[name].append(seconds)
    return times


def lose(tally: Tally, truths: Sequence[Any]) -> None:
    """All visible dots are lost."""
    for truth in truths:
        visible = np.count_nonzero(truth.visible)
        tally.percent(lost_percent=np.ones(visible), wrong_percent=np.zeros(visible))


def on_named(cases: Sequence[Case], folder: Path, methods: Sequence[str]) -> dict[str, Any]:
    """Named scenes: settings found on another recording of each of these sensors."""

    def settings_for(case: Case) -> dict[str, Settings]:
        other = recording(another(case), folder)
        loss = {name: partial(errors_of, follow, other, name) for name in methods}
        return {n: search(CHOICES.get(n, {}), lambda tried, n=n: badness(loss[n](tried))) for n in methods}

    return on_scenes(cases, folder, follow, settings_for)


def on_wide(count: int, methods: Sequence[str]) -> dict[str, Any]:
    """Random sensors, two pictures of each: one setting for all, found on one half, errors on the other."""
    found = (wide_scene(seed) for seed in range(FIRST_WIDE_SEED, FIRST_WIDE_SEED + 4 * count))
    scenes = [scene for scene in found if len(scene.origin) >= 9][: 2 * count]

    def errors(method: str, scenes: Sequence[WideScene], settings: Settings) -> Numbers:
        tally = Tally()
        for scene in scenes:
            truths = [_truth(scene, scene.origin), _truth(scene, scene.position)]
            follow((scene, [scene.reference, scene.picture], truths), {method: settings}, {method: tally})
        return tally.errors()

    answers = {}
    for name in methods:
        loss = partial(errors, name, scenes[::2])
        settings = search(CHOICES.get(name, {}), lambda tried, loss=loss: badness(loss(tried)))
        answers[name] = errors(name, scenes[1::2], settings) | {"settings": settings}
    return {"scenes": len(scenes[1::2]), "all": answers}


def _truth(scene: WideScene, position: Floats) -> Any:
    height, width = scene.contact.shape
    visible = ((position >= 0) & (position <= [width - 1, height - 1])).all(axis=1)
    return SimpleNamespace(
        origin=scene.origin.astype(np.float64), position=position.astype(np.float64), visible=visible
    )


def on_gels(data: Path, methods: Sequence[str]) -> dict[str, Any]:
    """Dots marked in pictures of real gels, in % of them: found, and false; by one setting that was chosen on
    the other labs, and by the one that is best for the very picture."""
    labels = [label for label in load_labels(judge_dots.DOTS) if label.dots]
    answers: dict[str, Any] = {}
    for name in methods:
        judged = {}
        for settings in combinations(FINDING.get(name, {})):
            finder = partial(FINDERS[name], **settings)
            judged[str(settings)] = list(judge_dots.judge(labels, data, finder, kinds=[""]))
        labs = sorted({frame.lab for frame in next(iter(judged.values()))})
        elsewhere = [
            min(judged.values(), key=lambda frames, lab=lab: missed(frames, lab, elsewhere=True))
            for lab in labs
        ]
        here = [min(judged.values(), key=lambda frames, lab=lab: missed(frames, lab)) for lab in labs]
        answers[name] = {
            key: shares(
                [
                    frame
                    for frames, lab in zip(chosen, labs, strict=True)
                    for frame in frames
                    if frame.lab == lab
                ]
            )
            for key, chosen in (("other labs", elsewhere), ("same lab", here))
        }
    return answers


def missed(frames: Sequence[judge_dots.FoundDots], lab: str, elsewhere: bool = False) -> float:
    """Mean over labs of the share of dots that are missed or false; of one lab, or of all others."""
    shares: dict[str, list[float]] = {}
    for frame in frames:
        if (frame.lab == lab) != elsewhere:
            shares.setdefault(frame.lab, []).append((frame.dots - frame.found + frame.false) / frame.dots)
    return float(np.mean([min(np.mean(values), 1.0) for values in shares.values()]))


def shares(frames: Sequence[judge_dots.FoundDots]) -> Numbers:
    dots = sum(frame.dots for frame in frames)
    return {
        "found": 100 * sum(frame.found for frame in frames) / dots,
        "false": 100 * sum(frame.false for frame in frames) / dots,
    }
