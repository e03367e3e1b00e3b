"""The verdict on a recording, in one line: good, usable with what to know, or bad.

`bad` is a recording to be made again: a tenth of it is not there, stands still or is damaged, or it has
another fault that makes errors several times as large. `usable` is one with a flaw that its users must know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Literal

from tactflow.recording.course import CODEC_REPEAT_SHARE, CONTACT_SECONDS, Course, Pause, Timing, seconds_text

Grade = Literal["good", "warning", "fault", "unknown"]

RECORDING_FINDINGS: Final = ("drop-outs", "timing", "frozen", "damage", "clipping", "step")
"""Findings about the recording itself. Their warnings make it `usable`; those about the sensor do not."""
BAD_LOSS_PERCENT: Final = 10.0
"""Share of a recording without which it is bad, %: one contact in ten is not in it."""
MENTIONED_LOSS_PERCENT: Final = 1.0
"""Share of a recording whose loss is mentioned, %."""
BAD_EVEN_LOSS_PERCENT: Final = 50.0
"""Share of evenly lost frames from which a recording is bad, %: every other frame and more."""
MENTIONED_IRREGULAR_PERCENT: Final = 5.0
"""Share of irregular intervals that is mentioned, %: two standard deviations of a normal distribution are
beyond half an interval."""
MENTIONED_RATE_RATIO: Final = 1.5
"""Ratio of the longest to the shortest local interval that is mentioned: half an interval."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a check.

    Attributes
    ----------
    number : measured value, in the unit of the check; None if the source cannot be checked.
    says : its description, or why it is unknown.
    effect : consequence of a fault for the errors, advice : remedy; both empty if good.
    limits : for warning and fault.
    verdict : `unknown` if the source cannot be checked.
    """

    number: float | None
    says: str
    effect: str = ""
    advice: str = ""
    limits: tuple[float, float] | None = None
    name: str = ""
    unit: str = ""
    verdict: Grade = "unknown"

    def graded(self, name: str, unit: str, limits: tuple[float, float]) -> Finding:
        """The finding with its verdict. limits : for warning and fault; if the second is smaller, low values
        are bad.

        >>> Finding(3.0, "3 % are missing").graded("drop-outs", "%", (1.0, 10.0)).verdict
        'warning'
        """
        if self.number is None:
            return replace(self, name=name, unit=unit)
        low, high = limits
        sign = -1.0 if high < low else 1.0
        number = sign * self.number
        found = replace(self, name=name, unit=unit, limits=limits)
        if number < sign * low:
            return replace(found, verdict="good", effect="", advice="")
        return replace(found, verdict="fault" if number >= sign * high else "warning")


@dataclass
class Recorded:
    """What is known about a recording, or the observation of a live source.

    Attributes
    ----------
    course : of its frames.
    timed : whether it has times; separate pictures have none.
    live : of a camera or stream.
    stopped : the error that ended it, or "".
    remark : what is wrong with its file, though all its frames can be read.
    lacking : frames that the file states but does not have.
    """

    course: Course = field(default_factory=Course)
    timed: bool = True
    live: bool = False
    stopped: str = ""
    remark: str = ""
    lacking: int = 0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict on a recording.

    Attributes
    ----------
    word : good, usable or bad.
    reasons : what is wrong, the worst first; empty if good.
    text : of a good recording: how much there is.
    """

    word: Literal["good", "usable", "bad"]
    reasons: tuple[str, ...]
    text: str = ""

    def __str__(self) -> str:
        return f"{self.word}: {'; '.join(self.reasons) or self.text}"


def examine_recording(recorded: Recorded) -> list[Finding]:
    """The findings about how something was recorded.

    >>> from tactflow.recording.course import Glance
    >>> recorded = Recorded()
    >>> for seq in range(30):
    ...     recorded.course.add(Glance(seq / 30, seq, 1.0, seq == 8, 0.0))
    >>> [finding.verdict for finding in examine_recording(recorded)]
    ['good', 'good', 'good', 'good', 'good']
    """
    timing = recorded.course.timing() if recorded.timed else None
    return [
        _drop_outs(recorded, timing),
        _timing(recorded, timing),
        _frozen(recorded, timing),
        _damage(recorded),
        _clipping(recorded),
    ]


def verdict_of(findings: Sequence[Finding], text: str = "") -> Verdict:
    """The verdict that follows from some findings. text : of a good recording.

    >>> str(verdict_of([Finding(20.0, "2 of 10 frames missing").graded("drop-outs", "%", (1, 10))]))
    'bad: 2 of 10 frames missing'
    """
    faults = [finding.says for finding in findings if finding.verdict == "fault"]
    flaws = [
        finding.says
        for finding in findings
        if finding.verdict == "warning" and finding.name in RECORDING_FINDINGS
    ]
    word: Literal["good", "usable", "bad"] = "bad" if faults else "usable" if flaws else "good"
    return Verdict(word, (*faults, *flaws), text)


def extent(recorded: Recorded) -> str:
    """How much there is: "1200 frames in 20.0 s"."""
    frames = recorded.course.frames
    if not recorded.timed:
        return f"{frames} pictures"
    return f"{frames} frames in {seconds_text(recorded.course.seconds)}"


def _drop_outs(recorded: Recorded, timing: Timing | None) -> Finding:
    """Missing and repeated frames. A recording from which every other frame is missing has a lower rate."""
    course = recorded.course
    late, pauses = (timing.lost, timing.pauses) if timing else (0, [])
    missing = max(late, course.missing)
    total = course.frames + missing
    # A picture that stands still is a finding of its own.
    stutters = course.repeated - (course.frozen.repeats if course.frozen else 0)
    repeated = 100.0 * stutters / max(total, 1) - (0.0 if recorded.live else 100.0 * CODEC_REPEAT_SHARE)
    says = f"{missing} of {total} frames missing, {course.repeated} repeated{_pauses_text(pauses)}"
    found = Finding(
        100.0 * (missing if recorded.live else late) / max(total, 1) + max(0.0, repeated),
        says + (f"; then: {recorded.stopped}" if recorded.stopped and recorded.live else ""),
        "contacts are detected late, and dots move further between frames",
        "another cable and port (no hub), fewer pixels or MJPG, less load on the processor",
    )
    if recorded.live:
        return replace(found, number=100.0 if recorded.stopped else found.number).graded(
            "drop-outs", "%", (MENTIONED_LOSS_PERCENT, BAD_LOSS_PERCENT)
        )
    graded = found.graded("drop-outs", "%", (MENTIONED_LOSS_PERCENT, BAD_EVEN_LOSS_PERCENT))
    paused = sum(pause.seconds for pause in pauses)
    if pauses and 100.0 * paused >= BAD_LOSS_PERCENT * course.seconds:
        return replace(graded, verdict="fault", effect=found.effect, advice=found.advice)
    if graded.verdict == "good" and (pauses or 100.0 * course.missing >= MENTIONED_LOSS_PERCENT * total):
        return replace(graded, verdict="warning", effect=found.effect, advice=found.advice)
    return graded


def _pauses_text(pauses: Sequence[Pause]) -> str:
    if not pauses:
        return ""
    longest = max(pauses, key=lambda pause: pause.seconds)
    others = f", and {len(pauses) - 1} more pauses" if len(pauses) > 1 else ""
    return f"; none for {seconds_text(longest.seconds)} from {longest.start:.1f} s on{others}"


def _timing(recorded: Recorded, timing: Timing | None) -> Finding:
    """Frames at uneven intervals."""
    if timing is None:
        few = f"{recorded.course.frames} frames are too few"
        why = few if recorded.timed else "single pictures have no times"
        return Finding(None, why, name="timing", unit="%")
    says = f"a frame every {seconds_text(timing.interval)}"
    share, ratio = 100.0 * timing.irregular, timing.slowest / timing.fastest
    if share >= MENTIONED_LOSS_PERCENT:
        says += f", {share:.0f} % of them more than half of that too early or late"
    if ratio >= MENTIONED_RATE_RATIO:
        says += f"; the rate changes between {1 / timing.slowest:.3g} and {1 / timing.fastest:.3g} frames/s"
    if timing.backwards:
        says += f"; the clock goes back {timing.backwards} times"
    found = Finding(
        share,
        says,
        "speeds are wrong where frames are counted instead of their times",
        "use the times of the frames; a fixed exposure; less load on the processor",
    )
    graded = found.graded("timing", "%", (MENTIONED_IRREGULAR_PERCENT, 100.0 + MENTIONED_IRREGULAR_PERCENT))
    if graded.verdict == "good" and (ratio >= MENTIONED_RATE_RATIO or timing.backwards):
        return replace(graded, verdict="warning", effect=found.effect, advice=found.advice)
    return graded


def _frozen(recorded: Recorded, timing: Timing | None) -> Finding:
    """A sensor that stood still."""
    course, run = recorded.course, recorded.course.frozen
    if course.frames < 3:
        return Finding(None, f"{course.frames} frames are too few", name="frozen", unit="%")
    seconds = run.repeats * timing.interval if run and timing else 0.0
    if run is None or (timing is not None and seconds < CONTACT_SECONDS and run.repeats < course.frames / 2):
        return Finding(0.0, "the picture never stands still").graded(
            "frozen", "%", (MENTIONED_LOSS_PERCENT, BAD_LOSS_PERCENT)
        )
    last = run.first + run.repeats
    if run.repeats == course.frames - 1:
        says = f"all {course.frames} pictures are the same"
    elif timing is None:
        says = f"pictures {run.first} to {last} are the same"
    else:
        begin = course.times[run.first] - course.times[0]
        rest = "to the end" if last == course.frames - 1 else "on"
        says = f"the picture stands still for {seconds_text(seconds)} from {begin:.1f} s {rest}"
    share = 100.0 * run.repeats / (course.frames - 1)
    found = Finding(
        max(share, MENTIONED_LOSS_PERCENT),
        says,
        "contacts of that time are missing, or last too long",
        "record it again; another cable and port, and no other program that uses the camera",
    )
    return found.graded("frozen", "%", (MENTIONED_LOSS_PERCENT, BAD_LOSS_PERCENT))


def _damage(recorded: Recorded) -> Finding:
    """Damaged pictures, and pictures of no gel; files that end too early."""
    course, lacking = recorded.course, recorded.lacking
    texts = [
        f"{tally.count} of {course.frames} pictures {words}, the first is number {tally.first}"
        for tally, words in ((course.damaged, "are damaged"), (course.empty, "show no gel"))
        if tally.count
    ]
    if lacking:
        texts.append(f"the file ends after {course.frames} of {course.frames + lacking} frames")
    texts += [text for text in (recorded.remark, "" if recorded.live else recorded.stopped) if text]
    share = 100.0 * (course.damaged.count + course.empty.count + lacking) / max(course.frames + lacking, 1)
    found = Finding(
        share,
        "; ".join(texts) or "no damaged picture",
        "results of damaged pictures are left out",
        "another cable and port, fewer pixels; tactflow repair keeps what is intact of an .mcap file",
    )
    if recorded.stopped and not recorded.live:
        found = replace(found, number=100.0)
    elif texts:
        found = replace(found, number=max(share, MENTIONED_LOSS_PERCENT))
    return found.graded("damage", "%", (MENTIONED_LOSS_PERCENT, BAD_LOSS_PERCENT))


# In a recording, clipping can no longer be repaired: with three quarters of its gel it can still be used.
def _clipping(recorded: Recorded) -> Finding:
    share = 100.0 * recorded.course.clipped
    return Finding(
        share,
        f"{round(share, 2):.2g} % of the gel is clipped",
        "a contact there has no shading, and a wrong centre",
        "less exposure or gain, fixed instead of automatic; lamps that do not shine into the camera",
    ).graded("clipping", "%", (1.5, 10.0 if recorded.live else 25.0))
