"""Measure all candidates on the fitted simulator and on the recording, and choose one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tactflow.bench.scenes import Case
from tactflow.engine.errors import SourceError
from tactflow.tune.measure import Trial, judge, mark_unsound, measure_on_recording
from tactflow.tune.recording import Recording
from tactflow.tune.sensor import Fitted, Look, fit
from tactflow.tune.space import ORIGINAL

SIMULATED: Final = (Case("press", 140), Case("slide", 80))
"""Simulated recordings: several depths and positions, and a drag. No cable: whether its ends are detected
under light pressure is random."""
ERROR_FACTOR: Final = 1.5
"""Without a budget, the largest acceptable error relative to the smallest. Chosen by hand."""
FLOW: Final = frozenset({"stages.field", "stages.flow_in_mask.method"})
"""Settings that change nothing but the mean flow."""


@dataclass(frozen=True)
class Goal:
    """The requested budgets: max_error, px of the camera image, and max_ms, ms per frame; None for none."""

    max_error: float | None = None
    max_ms: float | None = None

    def order(self, trials: Sequence[Trial]) -> list[Trial]:
        """Sort by preference: within the budgets first, then by time, or by error if only the time is
        limited."""
        by_error = self.max_ms is not None and self.max_error is None
        limit = self.error_limit(trials)

        def key(trial: Trial) -> tuple[float, ...]:
            error, ms = trial.error.value, trial.ms.value
            rank = (not trial.usable, not self.allows(trial, limit))
            return (*rank, error, ms) if by_error else (*rank, ms, error)

        return sorted(trials, key=key)

    def allows(self, trial: Trial, limit: float) -> bool:
        """Whether a trial is usable and within the budgets. limit : largest acceptable error, px."""
        return trial.usable and trial.error.value <= limit and trial.ms.value <= (self.max_ms or math.inf)

    def error_limit(self, trials: Sequence[Trial]) -> float:
        """Largest acceptable error, px."""
        if self.max_error is not None:
            return self.max_error
        if self.max_ms is not None:
            return math.inf
        return ERROR_FACTOR * min((trial.error.value for trial in trials if trial.usable), default=math.inf)


@dataclass
class Tuned:
    """Result of a search.

    trials : all candidates, best first. chosen : None if none is within the budgets. notes : remarks on the
    choice.
    """

    recording: Recording
    look: Look
    goal: Goal
    trials: list[Trial]
    chosen: Trial | None = None
    notes: list[str] = field(default_factory=list[str])


def search(
    candidates: list[Trial],
    recording: Recording,
    folder: Path,
    goal: Goal,
    say: Callable[[str], None] = lambda _: None,
) -> Tuned:
    """Measure all candidates, and choose the best.

    candidates : most expensive first. folder : for temporary files. say : called with progress messages.

    Raises
    ------
    SourceError
        No candidate detects the contacts of the simulated sensor, or runs on the recording.
    """
    look = fit(recording)
    say(f"fitted simulator: {look}")
    say(f"{len(candidates)} candidates on {sum(case.frames for case in SIMULATED)} simulated frames")
    judge(candidates, [Fitted(look, case, folder, case.frames) for case in SIMULATED])
    mark_unsound(candidates)
    _mark_unjudged_flow(candidates)
    _require_usable(candidates)
    say(f"the same on {recording.frames} frames of the recording")
    measure_on_recording(candidates, recording)
    _require_usable(candidates)
    tuned = Tuned(recording, look, goal, goal.order(candidates))
    tuned.chosen = _choose(tuned)
    return tuned


def _mark_unjudged_flow(trials: Sequence[Trial]) -> None:
    """Mark trials with another mean flow as unsound where none could be compared with the truth."""
    if any("flow" in trial.errors for trial in trials):
        return
    for trial in trials:
        if trial.settings.keys() & FLOW and trial.usable:
            trial.unsound = "its mean flow could not be judged: too few dots in the contact"


def _require_usable(trials: Sequence[Trial]) -> None:
    """Raise SourceError if no trial can be chosen."""
    if any(trial.usable for trial in trials):
        return
    reasons = [reason for trial in trials if (reason := trial.failure or trial.unsound)]
    why = reasons[0] if reasons else "none has an error that could be measured"
    raise SourceError(
        f"no pipeline works on the simulated sensor: {why}; see tactflow doctor, and tactflow detect"
    )


def _choose(tuned: Tuned) -> Trial | None:
    """The best trial likely to be within the budgets, else the best nominally within."""
    limit = tuned.goal.error_limit(tuned.trials)
    allowed = [trial for trial in tuned.trials if tuned.goal.allows(trial, limit)]
    if tuned.goal.max_error is not None:
        likely = [trial for trial in allowed if trial.error.likely <= limit]
        if allowed and not likely:
            tuned.notes.append("the budget lies within the interval of the chosen pipeline's error")
        allowed = likely or allowed
    # Keep the original unless the best is significantly faster.
    for trial in allowed:
        if trial.name == ORIGINAL and trial.ms.value <= allowed[0].ms.high:
            return trial
    return allowed[0] if allowed else None


def impossible(tuned: Tuned) -> str:
    """Message with the achievable time and error if no candidate is within the budgets."""
    usable = [trial for trial in tuned.trials if trial.usable]
    accurate = min(usable, key=lambda trial: trial.error.value)
    fastest = min(usable, key=lambda trial: trial.ms.value)
    possible = (
        f"{trial.error.value:.3g} px in {trial.ms.value:.3g} ms ({trial.name})"
        for trial in (accurate, fastest)
    )
    return f"no pipeline is within the budget. Possible: {', or '.join(possible)}"
