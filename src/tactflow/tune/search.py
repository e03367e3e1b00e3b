"""Successive halving: many candidates on a few frames, fewer on more, the last ones on the recording, too.

References
----------
K. Jamieson and A. Talwalkar, "Non-stochastic best arm identification and hyperparameter optimization",
AISTATS 2016.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from tactflow.bench.scenes import Case
from tactflow.bench.timing import CopyUnit
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.engine.graph import Pipeline
from tactflow.tune import checks
from tactflow.tune.measure import ANY, ERRORS, Found, Interval, judge, mark_unsound, on_sensor, set_time
from tactflow.tune.recording import Recording
from tactflow.tune.sensor import Fitted, Look, fit
from tactflow.tune.space import Candidate, candidates, with_more_references

ROUNDS: Final = (
    (Case("press", 24),),
    (Case("press", 48), Case("slide", 40)),
    (Case("press", 140), Case("slide", 80)),
)
"""Simulated recordings of each round; every round has another seed. By hand: a contact; a press and a drag;
several depths and places. No cable: lightly pressed, its ends are seen or not, whatever the pipeline."""
KEPT: Final = (1.0, 0.4, 0.4)
"""Share of the candidates of a round that goes on to the next but one. The front goes on in any case."""
FINALISTS: Final = 6
"""Candidates of the last round, at most. Chosen by hand."""
REFINED: Final = (Case("press", 140),)
"""Simulated recording for more references: untouched for 14 frames."""
GROUP: Final = 6
"""Candidates of the first round that take turns; between groups the budget may end it. Chosen by hand."""
FEWEST: Final = 3
"""Candidates with which a round is begun, at least. Chosen by hand."""
ALLOWED: Final = 1.5
"""Without a budget: the cheapest whose error is at most so many times the least. Chosen by hand."""
LIKELY: Final = 0.5
"""Part of the way from an error to the upper end of its 90 % interval that has to keep the budget: four of
five draws do. All of the way is dear: on a gel without dots it chose a pipeline of 2.3 times the time."""
DEFAULT: Final = "as given"
"""Name of the pipeline as the user gave it."""
ORIGINAL: Final = "original script"
"""Name of the original script's pipeline."""


@dataclass(frozen=True)
class Goal:
    """What is asked for.

    kind : of `ERRORS`. max_error : px of the camera's picture, or None. max_ms : ms a frame, or None.
    """

    kind: str = ANY
    max_error: float | None = None
    max_ms: float | None = None

    def order(self, found: Sequence[Found]) -> list[Found]:
        """The best first: what keeps the budgets before what does not; then time, or error if it is limited
        by time; then the other one."""
        bound = self.bound(found)

        def key(one: Found) -> tuple[float, ...]:
            error, ms = one.of(self.kind), one.ms.value
            if not one.usable or not math.isfinite(error):
                return (3.0, error, ms)
            if self.max_ms is not None and self.max_error is None:
                return (0.0, error, ms) if ms <= self.max_ms else (1.0, ms, error)
            if error > bound:
                return (1.0, error, ms)
            slow = self.max_ms is not None and ms > self.max_ms
            return (0.5 if slow else 0.0, ms, error)

        return sorted(found, key=key)

    def bound(self, found: Sequence[Found]) -> float:
        """The error that is allowed, px."""
        if self.max_error is not None:
            return self.max_error
        known = [one.of(self.kind) for one in found if one.usable]
        return ALLOWED * min(known, default=math.inf)


@dataclass
class Tuned:
    """The outcome.

    recording, look, goal : what was tuned for. found : everything of the last rounds, the best first, with
    the pipeline as given and the original script. front : names of those that no other beats in both time
    and error. chosen : the candidate, or None where none keeps the budgets. tried : how many candidates.
    words : what was decided on the way. rounds : candidates, frames of each round.
    timed_on_recording : whether times are of the recording, else of the simulated one.
    """

    recording: Recording
    look: Look
    goal: Goal
    found: list[Found]
    front: list[str]
    chosen: Candidate | None
    tried: int
    words: list[str] = field(default_factory=list[str])
    rounds: list[tuple[int, int]] = field(default_factory=list[tuple[int, int]])
    timed_on_recording: bool = False


class Search:
    """One search.

    Parameters
    ----------
    file : the user's pipeline. sensor : which of several, or None. original : the
    original script's pipeline, for comparison. goal : what is asked for.
    seconds : the budget. Finished in any case are a group of the first round, a simulated recording that is
    under way, and a turn of all candidates on the recording. seed : of the simulated recordings and the
    intervals. refine : whether more references are tried. say : told what happens.
    """

    def __init__(
        self,
        file: Path,
        goal: Goal,
        *,
        sensor: str | None = None,
        original: Path | None = None,
        seconds: float = 120.0,
        seed: int = 0,
        refine: bool = True,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._file, self._sensor, self._goal, self._original = file, sensor, goal, original
        self._end = time.monotonic() + seconds
        self._seed, self._refine, self._say = seed, refine, say
        self._unit = CopyUnit()
        self._words: list[str] = []
        self._timed_on_recording = False
        self._rounds: list[tuple[int, int]] = []
        self._known: dict[str, Candidate] = {}
        self._pace = 0.0

    def run(self, recording: Recording, folder: Path) -> Tuned:
        """Search.

        recording : what is tuned for. folder : for temporary files.

        Raises
        ------
        SourceError
            If no candidate finds the contacts of the simulated sensor.
        """
        base = Candidate(DEFAULT).load(self._file, self._sensor)
        look = fit(recording)
        self._say(f"simulated sensor: {look.words()}")
        dots = recording.seen.dots
        many = candidates(base, recording.size, None if dots is None else dots.pitch)
        self._known = {candidate.name: candidate for candidate in (Candidate(DEFAULT), *many)}
        script = self._script(look, folder)
        found = self._halve(list(self._known.values()), look, folder)
        if not any(one.usable and math.isfinite(one.of(self._goal.kind)) for one in found):
            raise SourceError(_nothing(found, self._goal))
        found = self._on_recording(found, recording, folder)
        chosen = self._choice(found)
        if chosen is not None and self._refine:
            chosen, found = self._refined(chosen, base, found, recording, look, folder)
        names = front(found, self._goal.kind)
        found += script
        return Tuned(
            *(recording, look, self._goal, self._goal.order(found), names, chosen, len(many)),
            words=self._words,
            rounds=self._rounds,
            timed_on_recording=self._timed_on_recording,
        )

    @property
    def _left(self) -> float:
        """Seconds of the budget that are left, 0 when it is over."""
        return max(0.0, self._end - time.monotonic())

    def _late(self) -> bool:
        return not self._left

    def _room(self, frames: int, share: float) -> int:
        """How many candidates can see so many frames in a share of the time that is left."""
        return int(share * self._left / max(self._pace * frames, 1e-6))

    def _halve(self, running: list[Candidate], look: Look, folder: Path) -> list[Found]:
        """All rounds on the simulator; what is known of the last one's candidates."""
        found: list[Found] = []
        for number, cases in enumerate(ROUNDS):
            started = time.monotonic()
            frames = sum(case.frames for case in cases)
            self._say(f"round {number + 1}: {len(running)} candidates, {frames} frames")
            if number:
                found = self._judged(running, cases, look, folder, self._seed + 100 * number)
            else:
                found = self._first_round(running, look, folder)
            mark_unsound(found)
            seen = max((one.frames for one in found), default=0)
            self._rounds.append((len(found), seen))
            self._pace = (time.monotonic() - started) / max(1, len(found) * seen)
            if number + 1 == len(ROUNDS):
                break
            # Half of the time is for what comes after the next round.
            room = self._room(sum(case.frames for case in ROUNDS[number + 1]), 0.5)
            if room < FEWEST:
                self._words.append(f"the budget was over after round {number + 1} of {len(ROUNDS)}")
                names = {candidate.name for candidate in self._kept(found, number, FINALISTS)}
                return [one for one in found if one.name in names]
            running = self._kept(found, number, room)
        return found

    def _first_round(self, running: Sequence[Candidate], look: Look, folder: Path) -> list[Found]:
        """All of them, a group at a time and the groups from all over the list, until the budget is over."""
        order = [0, *(1 + np.random.default_rng(self._seed).permutation(len(running) - 1))]
        groups = max(1, round(len(running) / GROUP))
        found: list[Found] = []
        for start in range(groups):
            if found and self._late():
                self._words.append(f"the budget was over after {len(found)} of {len(running)} candidates")
                break
            group = [running[index] for index in order[start::groups]]
            found += self._judged(group, ROUNDS[0], look, folder, self._seed)
        return found

    def _judged(
        self, running: Iterable[Candidate], cases: Sequence[Case], look: Look, folder: Path, seed: int
    ) -> list[Found]:
        pipelines: dict[str, Pipeline] = {}
        failed: list[Found] = []
        for candidate in running:
            try:
                pipelines[candidate.name] = on_sensor(candidate.load(self._file, self._sensor))
            except ConfigError as error:
                failed.append(Found(candidate.name, failure=str(error)))
        rendered = [Fitted(look, case, folder, seed + index) for index, case in enumerate(cases)]
        try:
            made = judge(pipelines, rendered, self._unit, self._seed, self._late)
        finally:
            for one in rendered:
                one.path.unlink(missing_ok=True)
        return [*made.values(), *failed]

    def _kept(self, found: list[Found], number: int, room: int) -> list[Candidate]:
        """Who goes on, `room` at most: the pipeline as given, the best by the goal, and the front."""
        want = max(FEWEST, math.ceil(KEPT[number + 1] * len(found)))
        if number + 2 == len(ROUNDS):
            want = min(want, FINALISTS)
        ordered = [one for one in self._goal.order(found) if one.failure is None]
        best = [one.name for one in ordered if one.usable][:want]
        best += [name for name in front(found, self._goal.kind) if name not in best][: FINALISTS // 2]
        first = next(iter(self._known))
        # The most expensive one is what the others are compared with.
        dearest = next(
            (name for name in list(self._known)[1:] if any(o.name == name for o in ordered)), first
        )
        names = dict.fromkeys([first, dearest, *best])
        there = {one.name for one in ordered}
        return [self._known[name] for name in names if name in there][:room]

    def _on_recording(self, found: list[Found], recording: Recording, folder: Path) -> list[Found]:
        """Times on the recording instead of the simulator's, and the checks without truth."""
        good = [one for one in found if one.failure is None]
        if self._room(recording.frames, 1.0) < len(good):
            self._words.append("no time was left for the recording: times are of the simulated one")
            return found
        dearest = list(self._known)[1:]
        good.sort(key=lambda one: dearest.index(one.name) if one.name in dearest else len(dearest))
        self._say(f"the recording: {len(good)} candidates, {recording.frames} frames, forward and backward")
        pipelines = {one.name: self._known[one.name].load(self._file, self._sensor) for one in good}
        compared, times, failures = checks.run(pipelines, recording, folder, self._unit, self._late)
        self._timed_on_recording = self._timed_on_recording or bool(times)
        if self._late():
            told = "some checks on the recording are missing"
            if not self._timed_on_recording:
                told = "times are of the simulated one"
            self._words.append(f"the budget was over while the recording was shown: {told}")
        for one in good:
            one.failure = failures.get(one.name)
            one.checks = compared.get(one.name, {})
            if one.name in times and one.failure is None:
                set_time(one, times[one.name], self._seed)
        return found

    def _script(self, look: Look, folder: Path) -> list[Found]:
        """The original script, for comparison: its time and error on one simulated press."""
        if self._original is None:
            return []
        self._say("the original script")
        pipeline = Candidate(ORIGINAL, (("stages.preprocess.rotate", 0),)).load(self._original)
        rendered = Fitted(look, ROUNDS[0][0], folder, self._seed)
        try:
            made = judge({ORIGINAL: on_sensor(pipeline)}, [rendered], self._unit, self._seed)
        finally:
            rendered.path.unlink(missing_ok=True)
        return list(made.values())

    def _choice(self, found: list[Found]) -> Candidate | None:
        """The best that most likely keeps the budgets, else the best that seems to."""
        goal = self._goal
        bound = goal.bound(found)
        ordered = [one for one in goal.order(found) if one.usable and math.isfinite(one.of(goal.kind))]
        fits = [
            one
            for one in ordered
            if (goal.max_ms is None or one.ms.value <= goal.max_ms)
            and ((goal.max_ms is not None and goal.max_error is None) or one.of(goal.kind) <= bound)
        ]
        sure = [one for one in fits if _likely(one.error[goal.kind]) <= bound]
        if fits and not sure and goal.max_error is not None:
            self._words.append("the budget lies within the interval of the chosen pipeline's error")
        picked = sure if sure and goal.max_error is not None else fits
        # A change that gains nothing is none.
        same = [one for one in picked if one.name == DEFAULT and one.ms.value <= picked[0].ms.high]
        return self._known[[*same, *picked][0].name] if picked else None

    def _refined(
        self,
        chosen: Candidate,
        base: Pipeline,
        found: list[Found],
        recording: Recording,
        look: Look,
        folder: Path,
    ) -> tuple[Candidate, list[Found]]:
        """The chosen one with more frames of the reference, where these make it more exact."""
        more = with_more_references(base, chosen)
        if more is None:
            return chosen, found
        shown = sum(len(order) for order in checks.orders(recording.frames).values())
        if self._room(sum(case.frames for case in REFINED) + shown, 1.0) < 2:
            self._words.append("no time was left to try more frames of the reference")
            return chosen, found
        self._known[more.name] = more
        self._say(more.name.removeprefix(f"{chosen.name}, "))
        again = self._judged([chosen, more], REFINED, look, folder, self._seed + 500)
        mark_unsound(again)
        again = self._on_recording(again, recording, folder)
        before, one = (next(f for f in again if f.name == name) for name in (chosen.name, more.name))
        if self._late() or not one.usable or not _better(one, before, self._goal):
            return chosen, found
        self._words.append(f"refined: {more.name.removeprefix(f'{chosen.name}, ')}")
        return more, [*found, one]


def _likely(error: Interval) -> float:
    """What an error most likely stays below, px."""
    return error.value + LIKELY * (error.high - error.value)


def _better(one: Found, before: Found, goal: Goal) -> bool:
    """Whether a refinement is worth it: a tenth less error at no more time."""
    return one.of(goal.kind) < 0.9 * before.of(goal.kind) and one.ms.value <= before.ms.high


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
    reasons = [one.failure or one.unsound for one in found if one.failure or one.unsound]
    why = f": {reasons[0]}" if reasons else f": none has a {ERRORS[goal.kind]}"
    return f"no pipeline works on the simulated sensor{why}; see tactflow doctor, and tactflow detect"


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
