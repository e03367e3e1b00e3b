"""Measure all candidates on the fitted simulator and on the recording, and choose one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tactflow.bench.report import pareto
from tactflow.bench.scenes import Case
from tactflow.engine.errors import SourceError
from tactflow.tune.measure import ANY, ERRORS, Trial, judge, mark_unsound, measure_on_recording
from tactflow.tune.recording import Recording
from tactflow.tune.sensor import Fitted, Look, fit
from tactflow.tune.space import ORIGINAL, Candidate

SIMULATED: Final = (Case("press", 140), Case("slide", 80))
"""Simulated recordings: several depths and positions, and a drag. No cable: whether its ends are detected
under light pressure is random."""
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

    trials : of all candidates, best first. front : names on the Pareto front of time and error. chosen : None
    if no candidate is within the budgets. notes : remarks on the choice.
    """

    recording: Recording
    look: Look
    goal: Goal
    trials: list[Trial] = field(default_factory=list[Trial])
    front: list[str] = field(default_factory=list[str])
    chosen: Candidate | None = None
    notes: list[str] = field(default_factory=list[str])


def search(
    known: Sequence[Candidate],
    recording: Recording,
    folder: Path,
    goal: Goal,
    say: Callable[[str], None] = lambda _: None,
) -> Tuned:
    """Measure all candidates, and choose the best.

    known : the candidates, most expensive first. folder : for temporary files. say : called with progress
    messages.

    Raises
    ------
    SourceError
        No candidate detects the contacts of the simulated sensor.
    """
    tuned = Tuned(recording, fit(recording), goal)
    say(f"fitted simulator: {tuned.look}")
    pipelines = {candidate.name: candidate.pipeline for candidate in known}
    say(f"{len(pipelines)} candidates on {sum(case.frames for case in SIMULATED)} simulated frames")
    tuned.trials = judge(pipelines, [Fitted(tuned.look, case, folder, case.frames) for case in SIMULATED])
    mark_unsound(tuned.trials)
    _mark_unjudged_flow(tuned.trials, known)
    _refuse_none(tuned.trials, goal)
    running = {trial.name: pipelines[trial.name] for trial in tuned.trials if trial.failure is None}
    say(f"{len(running)} candidates on {recording.frames} frames of the recording")
    measure_on_recording(running, tuned.trials, recording)
    _refuse_none(tuned.trials, goal)
    name = _choice(tuned)
    tuned.chosen = next((candidate for candidate in known if candidate.name == name), None)
    tuned.front = front(tuned.trials, goal.kind)
    tuned.trials = goal.order(tuned.trials)
    return tuned


def _mark_unjudged_flow(trials: Sequence[Trial], known: Sequence[Candidate]) -> None:
    """Mark trials with another mean flow as unsound where none could be compared with the truth."""
    if any("flow" in trial.errors for trial in trials):
        return
    changed = {candidate.name for candidate in known if candidate.settings.keys() & FLOW}
    for trial in trials:
        if trial.name in changed and trial.usable:
            trial.unsound = "its mean flow could not be judged: too few dots in the contact"


def _refuse_none(trials: Sequence[Trial], goal: Goal) -> None:
    """Raise SourceError if no trial can be chosen."""
    if any(trial.usable and math.isfinite(trial.of(goal.kind)) for trial in trials):
        return
    reasons = [trial.failure or trial.unsound for trial in trials if not trial.usable]
    why = reasons[0] if reasons else f"none has a {ERRORS[goal.kind]}"
    raise SourceError(
        f"no pipeline works on the simulated sensor: {why}; see tactflow doctor, and tactflow detect"
    )


def _choice(tuned: Tuned) -> str | None:
    """Name of the best candidate likely to be within the budgets, else of the best nominally within."""
    goal = tuned.goal
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
