"""Try all candidates on a few simulated frames, then the best on more frames and on the recording."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from tactflow.bench.report import pareto
from tactflow.bench.scenes import Case
from tactflow.engine.errors import SourceError
from tactflow.tune.measure import ANY, ERRORS, Trial, judge, mark_unsound, measure_on_recording
from tactflow.tune.recording import Recording
from tactflow.tune.sensor import Fitted, Look, fit
from tactflow.tune.space import ORIGINAL, Candidate

FIRST: Final = (Case("press", 24),)
"""Simulated recordings for all candidates: one contact."""
LAST: Final = (Case("press", 140), Case("slide", 80))
"""Simulated recordings for the finalists: several depths and positions, and a drag. No cable: whether its
ends are detected under light pressure is random."""
GROUP: Final = 6
"""Candidates evaluated in turns in the first round; the budget is checked between groups."""
FINALISTS: Final = 6
"""Candidates of the last round, in addition to the original, the most expensive one and the Pareto front."""
ERROR_FACTOR: Final = 1.5
"""Without a budget, the largest acceptable error relative to the smallest. Chosen by hand."""
FLOW: Final = frozenset({"stages.field", "stages.flow_in_mask.method"})
"""Settings that change nothing but the mean flow."""


@dataclass(frozen=True)
class Goal:
    """The requested budgets.

    kind : key of `ERRORS`. max_error : px of the camera image, or None. max_ms : ms per frame, or None.
    """

    kind: str = ANY
    max_error: float | None = None
    max_ms: float | None = None

    def order(self, trials: Sequence[Trial]) -> list[Trial]:
        """Sort by preference: within the budgets first, then by time, or by error if only the time is
        limited."""
        by_error = self.max_ms is not None and self.max_error is None
        bound = self.error_limit(trials)

        def key(trial: Trial) -> tuple[float, ...]:
            error, ms = trial.of(self.kind), trial.ms.value
            rank = (not trial.usable, not self.keeps(trial, bound))
            return (*rank, error, ms) if by_error else (*rank, ms, error)

        return sorted(trials, key=key)

    def keeps(self, trial: Trial, bound: float) -> bool:
        """Whether a trial is within the budgets. bound : largest acceptable error, px."""
        error = trial.of(self.kind)
        return math.isfinite(error) and error <= bound and trial.ms.value <= (self.max_ms or math.inf)

    def error_limit(self, trials: Sequence[Trial]) -> float:
        """Largest acceptable error, px."""
        if self.max_error is not None:
            return self.max_error
        if self.max_ms is not None:
            return math.inf
        return ERROR_FACTOR * min((trial.of(self.kind) for trial in trials if trial.usable), default=math.inf)


@dataclass
class Tuned:
    """Result of a search.

    trials : of the last round, best first. front : names on the Pareto front of time and error. chosen : None
    if no candidate is within the budgets. notes : steps skipped for lack of time. timed_on_recording :
    whether times were measured on the recording or on simulated frames.
    """

    recording: Recording
    look: Look
    goal: Goal
    trials: list[Trial] = field(default_factory=list[Trial])
    front: list[str] = field(default_factory=list[str])
    chosen: Candidate | None = None
    notes: list[str] = field(default_factory=list[str])
    timed_on_recording: bool = False


@dataclass
class Search:
    """A search for the best pipeline.

    seconds : time budget, checked after each group of the first round, each simulated recording, and every 20
    frames of the recording. seed : for simulated recordings and bootstrap intervals. say : called with
    progress messages.
    """

    goal: Goal
    seconds: float = 120.0
    seed: int = 0
    say: Callable[[str], None] = lambda _: None

    def run(self, known: Sequence[Candidate], recording: Recording, folder: Path) -> Tuned:
        """Run the search.

        known : the candidates, most expensive first. folder : for temporary files.

        Raises
        ------
        SourceError
            No candidate detects the contacts of the simulated sensor.
        """
        self._began, self._folder = time.monotonic(), folder
        tuned = Tuned(recording, fit(recording), self.goal)
        self.say(f"fitted simulator: {tuned.look}")
        # The others in random order, as the time may be over before all were tried.
        first = [known[0], *(c for c in known[1:] if c.name == ORIGINAL)]
        others = [c for c in known if c not in first]
        order = np.random.default_rng(self.seed).permutation(len(others))
        tuned.trials = self._round([*first, *(others[index] for index in order)], FIRST, tuned, GROUP)
        finalists = self._finalists(known, tuned.trials)
        if self._is_over(0.5):
            tuned.notes.append("out of time after the first round")
            names = {candidate.name for candidate in finalists}
            tuned.trials = [trial for trial in tuned.trials if trial.name in names]
        else:
            tuned.trials = self._round(finalists, LAST, tuned, len(finalists))
        running = {trial.name for trial in tuned.trials if trial.failure is None}
        pipelines = {c.name: c.pipeline for c in finalists if c.name in running}
        self.say(f"{len(pipelines)} candidates on {recording.frames} frames of the recording")
        tuned.timed_on_recording = measure_on_recording(
            pipelines, tuned.trials, recording, self.seed, self._is_over
        )
        if not tuned.timed_on_recording:
            tuned.notes.append("out of time during the recording: times are of simulated frames")
        name = self._choice(tuned)
        tuned.chosen = next((candidate for candidate in finalists if candidate.name == name), None)
        tuned.front = front(tuned.trials, self.goal.kind)
        tuned.trials = self.goal.order(tuned.trials)
        return tuned

    def _is_over(self, share: float = 1.0) -> bool:
        """Whether a fraction of the time budget has passed."""
        return time.monotonic() - self._began > share * self.seconds

    def _finalists(self, known: Sequence[Candidate], trials: Sequence[Trial]) -> list[Candidate]:
        """Select the most expensive, the original, the best and the front."""
        runs = {trial.name for trial in trials if trial.failure is None}
        best = [trial.name for trial in self.goal.order(trials) if trial.usable][:FINALISTS]
        chosen = {known[0].name, ORIGINAL, *best, *front(trials, self.goal.kind)}
        return [candidate for candidate in known if candidate.name in chosen & runs]

    def _round(
        self, known: Sequence[Candidate], cases: Sequence[Case], tuned: Tuned, size: int
    ) -> list[Trial]:
        """Evaluate candidates on simulated recordings, `size` of them in turns, until half of the budget has
        passed."""
        self.say(f"{len(known)} candidates on {sum(case.frames for case in cases)} simulated frames")
        rendered = [Fitted(tuned.look, case, self._folder, self.seed + case.frames) for case in cases]
        trials: list[Trial] = []
        for start in range(0, len(known), size):
            if trials and self._is_over(0.5):
                tuned.notes.append(f"out of time after {len(trials)} of {len(known)} candidates")
                break
            pipelines = {candidate.name: candidate.pipeline for candidate in known[start : start + size]}
            trials += judge(pipelines, rendered, self.seed, self._is_over)
        mark_unsound(trials)
        if not any("flow" in trial.errors for trial in trials):
            changed = {candidate.name for candidate in known if candidate.settings.keys() & FLOW}
            for trial in trials:
                if trial.name in changed and trial.usable:
                    trial.unsound = "its mean flow could not be judged: too few dots in the contact"
        kind = self.goal.kind
        if not any(trial.usable and math.isfinite(trial.of(kind)) for trial in trials):
            reasons = [trial.failure or trial.unsound for trial in trials if not trial.usable]
            why = reasons[0] if reasons else f"none has a {ERRORS[kind]}"
            raise SourceError(
                f"no pipeline works on the simulated sensor: {why}; see tactflow doctor, and tactflow detect"
            )
        return trials

    def _choice(self, tuned: Tuned) -> str | None:
        """Name of the best candidate likely to be within the budgets, else of the best nominally within."""
        goal = self.goal
        bound = goal.error_limit(tuned.trials)
        picked = [trial for trial in goal.order(tuned.trials) if trial.usable and goal.keeps(trial, bound)]
        if goal.max_error is not None:
            likely = [trial for trial in picked if trial.errors[goal.kind].likely <= bound]
            if picked and not likely:
                tuned.notes.append("the budget lies within the interval of the chosen pipeline's error")
            picked = likely or picked
        # Keep the original unless the best is significantly faster.
        same = [trial for trial in picked if trial.name == ORIGINAL and trial.ms.value <= picked[0].ms.high]
        return [*same, *picked][0].name if picked else None


def front(trials: Sequence[Trial], kind: str) -> list[str]:
    """Names of usable trials on the Pareto front of time and error, by increasing time."""
    usable = {trial.name: (trial.ms.value, trial.of(kind)) for trial in trials if trial.usable}
    return pareto({name: point for name, point in usable.items() if math.isfinite(point[1])})


def impossible(tuned: Tuned) -> str:
    """Message with the achievable time and error if no candidate is within the budgets."""
    kind = tuned.goal.kind
    usable = [trial for trial in tuned.trials if trial.usable and math.isfinite(trial.of(kind))]
    accurate = min(usable, key=lambda trial: trial.of(kind))
    fastest = min(usable, key=lambda trial: trial.ms.value)
    return (
        f"no pipeline is within the budget. Possible: {accurate.of(kind):.3g} px in "
        f"{accurate.ms.value:.3g} ms ({accurate.name}), or {fastest.of(kind):.3g} px in "
        f"{fastest.ms.value:.3g} ms ({fastest.name})"
    )
