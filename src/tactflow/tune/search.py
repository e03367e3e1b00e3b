"""Try all candidates on a few simulated frames, the best on more, and on the recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from tactflow.bench.scenes import Case
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.graph import Pipeline
from tactflow.tune.measure import ANY, ERRORS, Found, judge, mark_unsound, set_time, show_recording
from tactflow.tune.recording import Recording
from tactflow.tune.sensor import Fitted, Look, fit
from tactflow.tune.space import Candidate, candidates, with_more_references

FIRST: Final = (Case("press", 24),)
"""Simulated recordings that all candidates see: a contact."""
LAST: Final = (Case("press", 140), Case("slide", 80))
"""Simulated recordings that the finalists see: several depths and places, and a drag. No cable: lightly
pressed, its ends are seen or not, whatever the pipeline."""
GROUP: Final = 6
"""Candidates that take turns in the first round; between groups the budget may end it."""
FINALISTS: Final = 6
"""Candidates of the last round, besides the pipeline as given, the most expensive one and the front."""
ALLOWED: Final = 1.5
"""Without a budget: the cheapest whose error is at most so many times the least. Chosen by hand."""
LIKELY: Final = 0.5
"""Part of the way from an error to the upper end of its 90 % interval that has to keep the budget: four of
five draws do. All of the way is dear: on a gel without dots it chose a pipeline of 2.3 times the time."""
DEFAULT: Final = "as given"
"""Name of the pipeline as the user gave it."""


@dataclass(frozen=True)
class Goal:
    """What is asked for.

    kind : of `ERRORS`. max_error : px of the camera's picture, or None. max_ms : ms a frame, or None.
    """

    kind: str = ANY
    max_error: float | None = None
    max_ms: float | None = None

    def order(self, found: Sequence[Found]) -> list[Found]:
        """The best first: what keeps the budgets, by time, or by error if only the time is limited."""
        by_error = self.max_ms is not None and self.max_error is None
        bound = self.bound(found)

        def key(one: Found) -> tuple[float, ...]:
            error, ms = one.of(self.kind), one.ms.value
            rank = (not one.usable, not self.is_kept(one, bound))
            return (*rank, error, ms) if by_error else (*rank, ms, error)

        return sorted(found, key=key)

    def is_kept(self, one: Found, bound: float) -> bool:
        """Whether a candidate keeps the budgets. bound : of the error, px."""
        error = one.of(self.kind)
        return math.isfinite(error) and error <= bound and one.ms.value <= (self.max_ms or math.inf)

    def bound(self, found: Sequence[Found]) -> float:
        """The error that is allowed, px."""
        if self.max_error is not None:
            return self.max_error
        if self.max_ms is not None:
            return math.inf
        return ALLOWED * min((one.of(self.kind) for one in found if one.usable), default=math.inf)


@dataclass
class Tuned:
    """The outcome.

    recording, look, goal : what was tuned for. found : candidates of the last round, the best first. front :
    names of those that no other beats in both time and error. chosen : None where no candidate keeps the
    budgets. notes : what the budget left undone. rounds : candidates and simulated frames of each round.
    timed_on_recording : whether times are of the recording, else of the simulated one.
    """

    recording: Recording
    look: Look
    goal: Goal
    found: list[Found]
    front: list[str]
    chosen: Candidate | None
    notes: list[str] = field(default_factory=list[str])
    rounds: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    timed_on_recording: bool = False


@dataclass
class Search:
    """One search.

    file : the user's pipeline. sensor : which of several, or None. seconds : the budget; what is under way
    when it is over is finished: a group of the first round, a simulated recording, or 20 frames of the
    recording. seed : of the simulated recordings and the intervals. say : called with what happens.
    """

    file: Path
    goal: Goal
    sensor: str | None = None
    seconds: float = 120.0
    seed: int = 0
    say: Callable[[str], None] = lambda _: None

    def run(self, recording: Recording, folder: Path) -> Tuned:
        """Search. folder : for temporary files.

        Raises
        ------
        SourceError
            If no candidate finds the contacts of the simulated sensor.
        """
        self._began, self._folder = time.monotonic(), folder
        self._refined = ("", "")
        look = fit(recording)
        self.say(f"simulated sensor: {look}")
        base = Candidate(DEFAULT).load(self.file, self.sensor)
        dots = recording.seen.dots
        known = [Candidate(DEFAULT), *candidates(base, recording.size, None if dots is None else dots.pitch)]
        tuned = Tuned(recording, look, self.goal, [], [], None)
        tuned.found = self._first_round(known, tuned)
        finalists = self._finalists(known, tuned.found, base)
        if self._late(0.5):
            tuned.notes.append("the budget was over after the first round")
            names = {candidate.name for candidate in finalists}
            tuned.found = [one for one in tuned.found if one.name in names]
        else:
            tuned.found = self._last_round(finalists, tuned)
        if not any(math.isfinite(one.of(self.goal.kind)) for one in tuned.found if one.usable):
            raise SourceError(_nothing(tuned.found, self.goal))
        self._show_recording(finalists, tuned)
        name = self._choice(tuned)
        tuned.chosen = next((candidate for candidate in finalists if candidate.name == name), None)
        tuned.front = front(tuned.found, self.goal.kind)
        tuned.found = self.goal.order(tuned.found)
        return tuned

    def _late(self, share: float = 1.0) -> bool:
        """Whether a share of the budget is over."""
        return time.monotonic() - self._began > share * self.seconds

    def _first_round(self, known: Sequence[Candidate], tuned: Tuned) -> list[Found]:
        """All candidates, in groups from all over the list, until half of the budget is over."""
        self.say(f"round 1: {len(known)} candidates, {_frames(FIRST)} frames")
        # The pipeline as given, and the most expensive one, which others are compared with, come first.
        order = [0, 1, *(2 + np.random.default_rng(self.seed).permutation(len(known) - 2))]
        found: list[Found] = []
        for start in range(0, len(order), GROUP):
            if found and self._late(0.5):
                tuned.notes.append(f"the budget was over after {len(found)} of {len(known)} candidates")
                break
            group = [known[index] for index in order[start : start + GROUP]]
            found += self._judge(group, FIRST, tuned.look, self.seed)
        mark_unsound(found)
        tuned.rounds.append((len(found), _frames(FIRST)))
        return found

    def _finalists(
        self, known: Sequence[Candidate], found: Sequence[Found], base: Pipeline
    ) -> list[Candidate]:
        """The pipeline as given, the most expensive one, the best by the goal, and the front; of the best one
        also with more frames of the reference."""
        runs = {one.name for one in found if one.failure is None}
        best = [one.name for one in self.goal.order(found) if one.usable][:FINALISTS]
        names = [*(candidate.name for candidate in known[:2]), *best, *front(found, self.goal.kind)]
        by_name = {candidate.name: candidate for candidate in known}
        finalists = [by_name[name] for name in dict.fromkeys(names) if name in runs]
        more = with_more_references(base, by_name[best[0]]) if best else None
        if more is None:
            return finalists
        self._refined = (best[0], more.name)
        return [*finalists, more]

    def _last_round(self, finalists: Sequence[Candidate], tuned: Tuned) -> list[Found]:
        self.say(f"round 2: {len(finalists)} candidates, {_frames(LAST)} frames")
        found = self._judge(finalists, LAST, tuned.look, self.seed + 100)
        mark_unsound(found)
        tuned.rounds.append((len(found), _frames(LAST)))
        return found

    def _judge(self, group: Sequence[Candidate], cases: Sequence[Case], look: Look, seed: int) -> list[Found]:
        pipelines: dict[str, Pipeline] = {}
        failed: list[Found] = []
        for candidate in group:
            try:
                pipelines[candidate.name] = candidate.load(self.file, self.sensor)
            except ConfigError as error:
                failed.append(Found(candidate.name, failure=str(error)))
        rendered = [Fitted(look, case, self._folder, seed + index) for index, case in enumerate(cases)]
        try:
            return [*judge(pipelines, rendered, self.seed, self._late), *failed]
        finally:
            for recording in rendered:
                recording.path.unlink(missing_ok=True)

    def _show_recording(self, finalists: Sequence[Candidate], tuned: Tuned) -> None:
        """Take times on the recording instead of the simulator's, and the checks without truth."""
        if self._late():
            tuned.notes.append("no time was left for the recording: times are of the simulated one")
            return
        by_name = {one.name: one for one in tuned.found if one.failure is None}
        # The most expensive one comes first.
        good = [candidate for candidate in (*finalists[1:], finalists[0]) if candidate.name in by_name]
        self.say(f"the recording: {len(good)} candidates, {tuned.recording.frames} frames")
        pipelines = {candidate.name: candidate.load(self.file, self.sensor) for candidate in good}
        times, checks, failures = show_recording(pipelines, tuned.recording, self._late)
        tuned.timed_on_recording = bool(times)
        if self._late():
            missing = "some checks are missing" if times else "times are of the simulated one"
            tuned.notes.append(f"the budget was over while the recording was shown: {missing}")
        for name, one in by_name.items():
            one.failure = failures.get(name)
            one.checks = checks.get(name, {})
            if name in times and one.failure is None:
                set_time(one, times[name], self.seed)

    def _choice(self, tuned: Tuned) -> str | None:
        """Name of the best that most likely keeps the budgets, else of the best that seems to."""
        goal, kind = self.goal, self.goal.kind
        bound = goal.bound(tuned.found)
        fits = [one for one in goal.order(tuned.found) if one.usable and goal.is_kept(one, bound)]
        sure = [one for one in fits if _likely(one, kind) <= bound]
        if fits and not sure and goal.max_error is not None:
            tuned.notes.append("the budget lies within the interval of the chosen pipeline's error")
        picked = (sure or fits) if goal.max_error is not None else fits
        # Change nothing that gains nothing.
        same = [one for one in picked if one.name == DEFAULT and one.ms.value <= picked[0].ms.high]
        chosen = [*same, *picked][0].name if picked else None
        # More references cost no time a frame: take them if they lower the error by a tenth.
        errors = {one.name: one.of(kind) for one in fits}
        plain, more = self._refined
        if chosen in (plain, more) and errors.keys() >= {plain, more}:
            chosen = more if errors[more] < 0.9 * errors[plain] else plain
        return chosen


def _frames(cases: Sequence[Case]) -> int:
    return sum(case.frames for case in cases)


def _likely(one: Found, kind: str) -> float:
    """What an error most likely stays below, px."""
    error = one.errors[kind]
    return error.value + LIKELY * (error.high - error.value)


def front(found: Sequence[Found], kind: str) -> list[str]:
    """Names of the usable ones that no other beats in both time and error, by rising time."""
    names: list[str] = []
    least = math.inf
    for one in sorted(found, key=lambda f: (f.ms.value, f.of(kind))):
        if one.usable and one.of(kind) < least:
            least = one.of(kind)
            names.append(one.name)
    return names


def _nothing(found: Sequence[Found], goal: Goal) -> str:
    reasons: Iterator[str] = (one.failure or one.unsound for one in found if one.failure or one.unsound)
    why = next(reasons, f"none has a {ERRORS[goal.kind]}")
    return f"no pipeline works on the simulated sensor: {why}; see tactflow doctor, and tactflow detect"


def impossible(tuned: Tuned) -> str:
    """What can be had where the budgets cannot be kept."""
    kind = tuned.goal.kind
    usable = [one for one in tuned.found if one.usable and math.isfinite(one.of(kind))]
    exact = min(usable, key=lambda one: one.of(kind))
    fast = min(usable, key=lambda one: one.ms.value)
    return (
        f"no pipeline keeps the budget. Possible: {exact.of(kind):.3g} px in {exact.ms.value:.3g} ms "
        f"({exact.name}), or {fast.ms.value:.3g} ms with {fast.of(kind):.3g} px ({fast.name})"
    )
