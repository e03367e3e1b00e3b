"""Measure all candidates on the fitted simulator and on the recording, and choose one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tactflow.engine.errors import SourceError
from tactflow.tools.bench.scenes import Case
from tactflow.tools.tune.measure import Trial, judge, mark_unsound, measure_on_recording
from tactflow.tools.tune.recording import Recording
from tactflow.tools.tune.sensor import Fitted, Look, fit
from tactflow.tools.tune.space import ORIGINAL

SIMULATED_CASES: Final = (Case("press", 140), Case("slide", 80))
"""Simulated recordings: several depths and positions, and a drag. No cable: whether its ends are detected
under light pressure is random."""
ERROR_FACTOR: Final = 1.5
"""Without a budget, the largest acceptable error relative to the smallest. Chosen by hand."""
MAX_TIME_RATIO: Final = 0.95
"""Time, relative to the user's own pipeline, above which another one does not replace it: less is within the
scatter of two measurements. Chosen by hand."""

FIRST_LOOK: Final = Case("press", 24)
"""Short recording on which single swaps are compared with the original, before those that are worth it are
measured like the other candidates."""
FIRST_LOOK_S, FIRST_TURN_FRAMES = 3.0, 4
"""CPU time on that recording after which a swap is too slow, s, about 15 times that of the default pipeline;
frames in a turn, so that a swap of a second a frame does not take much longer."""


@dataclass(frozen=True)
class Goal:
    """The requested budgets: max_error, px of the camera image, and max_ms, ms per frame; None for none."""

    max_error: float | None = None
    max_ms: float | None = None

    def order(self, trials: Sequence[Trial]) -> list[Trial]:
        """Sort by preference: within the budgets first, then by time, or by error if only the time is
        limited."""
        allowed = self.allowed(trials)
        by_error = self.max_ms is not None and self.max_error is None

        def key(trial: Trial) -> tuple[float, ...]:
            values = (trial.error, trial.ms) if by_error else (trial.ms, trial.error)
            return (not trial.usable, trial not in allowed, *values)

        return sorted(trials, key=key)

    def allowed(self, trials: Sequence[Trial]) -> list[Trial]:
        """The usable trials within the budgets."""
        usable = [trial for trial in trials if trial.usable]
        max_error, max_ms = self.max_error or math.inf, self.max_ms or math.inf
        if self.max_error is None and self.max_ms is None:
            max_error = ERROR_FACTOR * min((trial.error for trial in usable), default=math.inf)
        return [trial for trial in usable if trial.error <= max_error and trial.ms <= max_ms]

    def choose(self, trials: Sequence[Trial]) -> Trial | None:
        """The best of the allowed trials; the original, unless another is significantly faster."""
        allowed = self.order(self.allowed(trials))
        for trial in allowed:
            if trial.name == ORIGINAL and MAX_TIME_RATIO * trial.ms <= allowed[0].ms:
                return trial
        return allowed[0] if allowed else None


@dataclass(frozen=True)
class Tuned:
    """Result of a search.

    Attributes
    ----------
    trials : all candidates, best first.
    chosen : None if none is within the budgets.
    """

    recording: Recording
    look: Look
    trials: list[Trial]
    chosen: Trial | None = None

    def impossible(self) -> str:
        """Message with the achievable time and error if no candidate is within the budgets."""
        usable = [trial for trial in self.trials if trial.usable]
        best = min(usable, key=lambda trial: trial.error), min(usable, key=lambda trial: trial.ms)
        possible = ", or ".join(f"{trial.error:.3g} px in {trial.ms:.3g} ms ({trial.name})" for trial in best)
        return f"no pipeline is within the budget. Possible: {possible}"


def search(
    candidates: list[Trial],
    recording: Recording,
    folder: Path,
    goal: Goal,
    say: Callable[[str], None] = lambda _: None,
    swaps: Sequence[Trial] = (),
) -> Tuned:
    """Measure all candidates, and choose the best.

    candidates : most expensive first, the original among them. folder : for temporary files. say : called
    with progress messages. swaps : further candidates, each of which changes one stage of the original; those
    that are neither faster nor more accurate than it at first sight are left out.

    Raises
    ------
    SourceError
        No candidate detects the contacts of the simulated sensor, or runs on the recording.
    """
    look = fit(recording)
    say(f"fitted simulator: {look}")
    if swaps:
        worth = _at_first_sight(swaps, candidates, Fitted(look, FIRST_LOOK, folder, FIRST_LOOK.frames))
        say(f"{len(swaps)} stages swapped, worth a closer look: {', '.join(t.name for t in worth) or 'none'}")
        candidates = [*candidates, *worth]
    say(f"{len(candidates)} candidates on {sum(case.frames for case in SIMULATED_CASES)} simulated frames")
    judge(candidates, [Fitted(look, case, folder, case.frames) for case in SIMULATED_CASES])
    mark_unsound(candidates)
    _require_usable(candidates)
    say(f"the same on {recording.frames} frames of the recording")
    measure_on_recording(candidates, recording)
    _require_usable(candidates)
    return Tuned(recording, look, goal.order(candidates), goal.choose(candidates))


def _at_first_sight(swaps: Sequence[Trial], candidates: Sequence[Trial], rendered: Fitted) -> list[Trial]:
    """The swaps that are sound, and faster or more accurate than the original, on a short recording."""
    original = next(trial for trial in candidates if trial.name == ORIGINAL)
    reference = Trial(ORIGINAL, {}, original.pipeline)
    compared = [reference, *(Trial(swap.name, swap.settings, swap.pipeline) for swap in swaps)]
    ms = judge(compared, [rendered], FIRST_TURN_FRAMES, FIRST_LOOK_S)
    mark_unsound(compared)
    better = {
        trial.name
        for trial in compared[1:]
        if trial.usable
        and (
            ms[trial.name] < MAX_TIME_RATIO * ms.get(ORIGINAL, math.inf)
            or trial.error < MAX_TIME_RATIO * reference.error
        )
    }
    return [swap for swap in swaps if swap.name in better]


def _require_usable(trials: Sequence[Trial]) -> None:
    """Raise SourceError if no trial can be chosen."""
    if not any(trial.usable for trial in trials):
        faults = [trial.fault for trial in trials if trial.fault]
        why = faults[0] if faults else "none has an error that could be measured"
        raise SourceError(
            f"no pipeline works on this sensor: {why}; see tactflow doctor, and tactflow detect"
        )
