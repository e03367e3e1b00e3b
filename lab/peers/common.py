"""What the quantities share: turns, timing, the search for a peer's settings, the length of an adapter."""

from __future__ import annotations

import ast
import inspect
import textwrap
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow import Preprocessor
from tactflow.tools.bench.quantities import Tally
from tactflow.tools.bench.scenes import Case, rendered
from tactflow.tools.bench.timing import TURN_FRAMES

Picture = NDArray[np.uint8]
Numbers = dict[str, float]
Settings = dict[str, Any]
Scene = tuple[Any, Sequence[Picture], Sequence[Any]]
"""A simulated scene, its processed pictures, the truth about each."""
Follow = Callable[[Scene, Mapping[str, Settings], Mapping[str, Tally]], dict[str, list[float]]]
"""Runs methods with their settings over a scene, in turns, and adds their errors to the tallies; times, s."""


def one_thread() -> None:
    """One thread in OpenCV and PyTorch, whatever a peer sets."""
    cv2.setNumThreads(1)
    try:
        import torch
    except ImportError:
        return
    torch.set_num_threads(1)


FAILURES: dict[str, dict[str, int]] = {}
"""Method -> first line of an error that it raised -> how often."""


def failed(method: str, error: Exception) -> None:
    """Count an error of a method."""
    text = f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error).strip() else ''}"
    counts = FAILURES.setdefault(method, {})
    counts[text] = counts.get(text, 0) + 1


class Calls:
    """A method as a function of one picture, called for each of a recording, a block at a time."""

    def __init__(self, method: Callable[[Picture], Any], pictures: Sequence[Picture]) -> None:
        self._method, self._pictures, self._next = method, pictures, 0

    def block(self, frames: int) -> list[tuple[Any, float]]:
        """Answers to the next pictures, an exception where one was raised, and the CPU time of each, s."""
        answers = []
        for picture in self._pictures[self._next : self._next + frames]:
            given = picture.copy()  # some draw on it
            began = time.thread_time()
            try:
                answer = self._method(given)
            except Exception as error:  # whatever a peer raises where it cannot go on
                answer = error
            answers.append((answer, time.thread_time() - began))
        self._next += frames
        return answers


def turns(methods: Mapping[str, Any]) -> Iterator[tuple[str, int, Any, float]]:
    """(name, index of the frame, answer, s) of each frame; methods take turns of `TURN_FRAMES` (A B A B)."""
    index = dict.fromkeys(methods, 0)
    running = list(methods)
    while running:
        for name in list(running):
            answers = methods[name].block(TURN_FRAMES)
            for answer, seconds in answers:
                yield name, index[name], answer, seconds
                index[name] += 1
            if len(answers) < TURN_FRAMES:
                running.remove(name)


def search(choices: Mapping[str, Sequence[Any]], loss: Callable[[Settings], Any]) -> Settings:
    """The settings with the least loss, one setting after the other, from the first choice of each."""
    if not choices:
        return {}
    best = {name: values[0] for name, values in choices.items()}
    least = loss(best)
    for name, values in choices.items():
        for value in values[1:]:
            tried = best | {name: value}
            if (found := loss(tried)) < least:
                best, least = tried, found
    return best


def combinations(choices: Mapping[str, Sequence[Any]]) -> list[Settings]:
    """Every combination of the choices."""
    return [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]


def another(case: Case) -> Case:
    """Another recording of the same sensor, half as long."""
    return replace(case, frames=case.frames // 2, query=f"{case.query}&seed=11".lstrip("&"))


def recording(case: Case, folder: Path) -> Scene:
    """A simulated scene, its pictures as the shipped pipeline prepares them (turned, at half the size), and
    the truth about these."""
    with rendered(case, folder) as scene:
        height, width = scene.frames[0].shape[:2]
        preprocess = Preprocessor((width, height), rotate=90, downsample=2)
        pictures = [preprocess(np.array(frame)).copy() for frame in scene.frames]
        return scene, pictures, scene.truths(preprocess.mapping)


def errors_of(follow: Follow, scene: Scene, method: str, settings: Settings) -> Numbers:
    """The errors of one method on a recording."""
    tally = Tally()
    follow(scene, {method: settings}, {method: tally})
    return tally.errors()


def on_scenes(
    cases: Sequence[Case], folder: Path, follow: Follow, settings_for: Callable[[Case], dict[str, Settings]]
) -> dict[str, Any]:
    """Errors of every method by scene and over all of them, with its settings; median CPU time, ms."""
    scenes, whole, times = {}, defaultdict(Tally), defaultdict(list)
    for case in cases:
        settings = settings_for(case)
        tallies = {name: Tally() for name in settings}
        for name, taken in follow(recording(case, folder), settings, tallies).items():
            times[name] += taken
        for name, tally in tallies.items():
            for key, values in tally.values.items():
                whole[name].values[key] += values
        scenes[case.label] = {n: tally.errors() | {"settings": settings[n]} for n, tally in tallies.items()}
    every = {name: tally.errors() | {"settings": settings[name]} for name, tally in whole.items()}
    ms = {name: 1e3 * median(taken) for name, taken in times.items()}
    return {"scenes": scenes, "all": every, "ms": ms}


def lines(adapter: Callable[..., Any]) -> int:
    """Lines of code of an adapter, without docstrings, comments and blank lines."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(adapter)))
    return len(ast.unparse(_without_docstrings(tree)).splitlines())


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return tree
