"""A calibration session: results of a run come in, a calibration goes out, and a person is told what to do.

A session does not know where its results come from. It is given a function that plays a pipeline (`Play`),
and one that shows a line (`Say`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, Protocol

from tactflow.calibration import force_samples
from tactflow.calibration.darkness import fit_darkness
from tactflow.calibration.file import UNLIKE, Calibration, ScaleEntry, raw_corners, small_picture
from tactflow.calibration.force import fit_force
from tactflow.calibration.guide import Guide
from tactflow.calibration.judgement import FEWEST_PRESSES, STRETCHED, doubt
from tactflow.calibration.likeness import place
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import NEEDED, PressFinder, Session
from tactflow.calibration.reference import Reference, read_reference
from tactflow.calibration.refine import apparent_radius, refine_photometry
from tactflow.calibration.scale import scale_from_area, scale_from_pitch
from tactflow.calibration.weights import Weighed, WeightGuide, fit_loads
from tactflow.calibration.words import darkness_words, force_words, photometric_words
from tactflow.engine.contract import Source
from tactflow.engine.errors import ConfigError, TactflowError
from tactflow.message.result import Result
from tactflow.system.redaction import public_address
from tactflow.vision.types import Scale

LARGEST_SCALE_ERROR: Final = 0.02
"""Relative error of a scale by pitch above which a better method is advised: grids of the simulator have less
than 0.01, the rings of a TacTip 0.1 to 0.15."""

Method = Literal["slopes", "refine", "darkness"]
"""How depth is learned: from colours, from colours beginning with another calibration, from darkening."""

ENOUGH_PRESSES: Final[Mapping[Method, int]] = {"slopes": 30, "refine": 9, "darkness": 1}
"""Number of presses that ends a live session. With 9, a refined default has the errors of a calibration of
its own on two Minis; one curve of darkness holds all over the gel."""

Say = Callable[[str], None]
"""Shows a line."""


class Play(Protocol):
    """Plays a pipeline to the end of its source."""

    def __call__(
        self,
        take: Callable[[Result, Source], bool],
        needed: Mapping[str, str],
        calibration: Path | None = None,
    ) -> None:
        """Call `take` with every result and the source; the run ends when it returns False.

        needed : port -> the stage that gives it. calibration : file with which the pipeline runs, or None.
        """


@dataclass(frozen=True)
class Wish:
    """What to calibrate.

    pitch : spacing of the dots, mm. area : width and height of the processed picture, mm; at most one of the
    two, and for `refine` maybe neither. ball_radius : mm; None for the scale alone. method : of the depth.
    gel_thickness : mm; None for that of the pipeline's calibration.

    Raises ConfigError if this gives no calibration.
    """

    pitch: float | None = None
    area: tuple[float, float] | None = None
    ball_radius: float | None = None
    method: Method = "slopes"
    gel_thickness: float | None = None

    def __post_init__(self) -> None:
        refines, ways = self.method == "refine", [self.pitch, self.area].count(None)
        if ways == 0 or (ways == 2 and not refines):
            raise ConfigError("calibrate: required one of --pitch MM and --area WIDTH HEIGHT, for the scale")
        if self.method == "darkness" and self.ball_radius is None:
            raise ConfigError("calibrate --darkness: required --ball-radius MM, and not --refine")
        if refines and self.ball_radius is None:
            raise ConfigError("calibrate --refine: required --ball-radius MM, of the ball that is pressed")


def instruction(ball_radius: float | None, presses: int) -> str:
    """What to do with the sensor. ball_radius : mm; None without a ball. presses : that are enough.

    >>> instruction(None, 30)
    'Leave the gel untouched.'
    """
    if ball_radius is None:
        return "Leave the gel untouched."
    number = "One press" if presses == 1 else f"{presses} presses"
    return (
        "Leave the gel untouched at first. Then press the ball, lift it, and press it somewhere else, all "
        f"over the gel and to several depths. {number} are enough; Ctrl-C ends earlier."
    )


def find_presses(play: Play, guide: Guide | None) -> Session:
    """The presses that a source shows; of a live one until there are enough.

    guide : None if the untouched gel is enough.
    """
    finder = PressFinder()
    enough = guide is None

    def take(result: Result, source: Source) -> bool:
        nonlocal enough
        finder.pictures = source.pictures
        finder.add(result)
        enough = (guide is not None and guide(finder)) or enough
        # All frames of the reference count, however many presses there are.
        return not (enough and source.live and not result.frame.reference)

    play(take, NEEDED)
    return finder.session()


def learn(
    session: Session, wish: Wish, base: Calibration | None, say: Say, *, sensor: str, made_from: str
) -> Calibration:
    """The calibration that a session gives. sensor, made_from : its name, and the source of the session.

    base : of the pipeline, where a refinement begins; otherwise it only helps to judge. Raises ConfigError if
    the session gives no calibration.
    """
    base = None if base is None else _fitting_base(session, wish, base, say)
    scale, found_by = _scale(session, wish, base)
    say(
        f"scale: {scale.x:.5f} +- {scale.stderr[0]:.5f} mm per px in x, "
        f"{scale.y:.5f} +- {scale.stderr[1]:.5f} in y"
    )
    error = max(scale.stderr[0] / scale.x, scale.stderr[1] / scale.y)
    if wish.pitch is not None and error > LARGEST_SCALE_ERROR:
        say(
            f"that is an error of {100 * error:.1f} %: --pitch is for dots in a square grid; these are "
            "not, or the picture is stretched. Use --area WIDTH HEIGHT, the size of the whole picture"
        )
    ratio = max(scale.x / scale.y, scale.y / scale.x)
    if wish.area is not None and ratio > STRETCHED:
        say(
            f"pixels are {ratio:.2f} times as long in one direction as in the other: is --area the WIDTH and "
            "then the HEIGHT of the picture as it is processed?"
        )
    depth: dict[str, Any] = {}
    if wish.ball_radius is not None:
        count = len(session.presses)
        say("1 press; learning from it ..." if count == 1 else f"{count} presses; learning from them ...")
        depth = _depth(session, wish.method, wish.ball_radius, scale, base, say)
    return Calibration(
        sensor=sensor,
        made_from=made_from,
        raw_size=session.mapping.raw_size,
        size=session.mapping.size,
        corners=raw_corners(session.mapping),
        scale=ScaleEntry.of(scale, found_by),
        gel_thickness=wish.gel_thickness or (None if base is None else base.gel_thickness),
        look=small_picture(session.untouched),
        **depth,
    )


def _fitting_base(session: Session, wish: Wish, base: Calibration, say: Say) -> Calibration | None:
    """The calibration of the pipeline, as it is for the pictures of the session; None where it does not fit.

    Raises ConfigError if it does not fit, and a refinement was to have its scale.
    """
    size = session.mapping.size
    words = base.misfit(session.mapping)
    if words is None and base.kind is None:
        unlike = base.unlikeness(session.untouched)
        if unlike <= UNLIKE:
            return base
        words = f"its untouched gel differs by {100 * unlike:.0f} % of its brightness: another sensor"
    elif words is None:
        scale, words = place(base, session.untouched, session.mapping, session.dots)
        if scale is not None:
            return base.at(scale, size)
        if wish.method == "refine" and base.slopes is None:
            # Lengths do not depend on the light.
            return base
    if wish.method == "refine":
        if wish.pitch is None and wish.area is None:
            raise ConfigError(f"calibrate --refine: the calibration of the pipeline does not fit: {words}")
        say(f"the calibration of the pipeline does not fit, and a new one is made: {words}")
    return None


def _scale(session: Session, wish: Wish, base: Calibration | None) -> tuple[Scale, str]:
    """Millimetres per pixel, and how they were found; those of the base unless the wish gives some."""
    size = session.mapping.size
    try:
        if wish.pitch is not None:
            return scale_from_pitch(session.dots, wish.pitch, size), f"pitch of {wish.pitch:g} mm"
        if wish.area is not None:
            width, height = wish.area
            return scale_from_area(wish.area, size), f"area of {width:g} x {height:g} mm"
        if base is None:
            raise ConfigError(
                "calibrate --refine: required one of --pitch MM and --area WIDTH HEIGHT, for the scale, "
                "since the pipeline has no calibration"
            )
        return base.scale_at(size), base.scale_entry.found_by
    except ValueError as problem:
        raise ConfigError(f"calibrate: {problem}") from None


def _depth(
    session: Session, method: Method, radius: float, scale: Scale, base: Calibration | None, say: Say
) -> dict[str, Any]:
    """The fit of the depth, as fields of `Calibration`. radius : of the ball, mm."""
    apparent = None
    if method == "darkness":
        darkness = fit_darkness(session, scale, radius)
        kept, misfits, rejected = darkness.kept, darkness.misfit, "too small, or larger than the ball"
        fields: dict[str, Any] = {"darkness": darkness.found}
        words = darkness_words(darkness.found)
    else:
        if base is not None and base.slopes is not None:
            apparent = apparent_radius(session, scale, radius, base)
        if method == "refine" and base is not None and base.slopes is not None:
            colours = refine_photometry(session, scale, radius, base)
        else:
            colours = fit_photometry(session, scale, radius)
        kept, misfits, rejected = colours.kept, colours.misfit, "{:.0f} degrees off a ball's surface"
        fields = {
            "photometric": colours.found,
            "slopes": colours.model,
            "information": colours.information,
        }
        words = photometric_words(colours.found.model_dump())
        if colours.found.presses < FEWEST_PRESSES:
            words += "; more presses, all over the gel, make it better"
    if (question := doubt(session, scale, radius, apparent)) is not None:
        say(question)
    for press, is_kept, misfit in zip(session.presses, kept, misfits, strict=True):
        if not is_kept:
            say(f"the press of frame {press.seq} is left out: {rejected.format(misfit)}")
    say(words)
    return fields


def watch(play: Play, calibration: Path) -> force_samples.Watched:
    """Features for the force. calibration : the file, with a scale."""
    watcher = force_samples.Watcher()

    def take(result: Result, source: Source) -> bool:
        watcher.pictures = source.pictures
        watcher.add(result)
        return True

    play(take, force_samples.NEEDED, calibration)
    return watcher.watched()


def weigh(play: Play, calibration: Path, guide: WeightGuide) -> None:
    """Find the loads that a source shows; of a live one until all were put on. calibration : the file.

    Raises ConfigError for pictures that were taken one by one.
    """

    taken_singly = False

    def take(result: Result, source: Source) -> bool:
        nonlocal taken_singly
        taken_singly, guide.live = source.pictures, source.live
        return not (taken_singly or (guide(result) and source.live))

    play(take, force_samples.NEEDED, calibration)
    if taken_singly:
        raise ConfigError(
            "calibrate --weights: pictures that were taken one by one do not show whether a load lies still; "
            "name the force of each in a CSV instead, with the columns file and fz (--csv)"
        )


def learn_force(
    calibration: Calibration,
    gauges: Mapping[str, Path],
    watched: Callable[[str], force_samples.Watched],
    offset: float,
    say: Say,
) -> Calibration:
    """A calibration with the force, from recordings with the readings of a gauge.

    gauges : recording -> its readings. watched : the features of a recording. offset : to be added to the
    times of the readings, s. A recording of several that cannot be used is left out.

    Raises TactflowError if none can be used.
    """
    features: dict[str, force_samples.Watched] = {}
    readings: dict[str, Reference] = {}
    for name, file in gauges.items():
        try:
            reading = read_reference(file, name).later(offset)
            found = watched(name)
            force_samples.align(name, found, reading, found.change_at_rest)
        except TactflowError as problem:
            if len(gauges) == 1:
                raise
            say(f"{name} is left out: {problem}")
            continue
        features[name], readings[name] = found, reading
        say(f"{name}: {len(found.touched)} frames, {found.touched.sum()} of them with contact")
    if not features:
        raise ConfigError(f"calibrate force: none of the {len(gauges)} recordings can be used")
    fit = fit_force(features, readings)
    for words in force_words(fit, readings):
        say(words)
    return calibration.model_copy(update={"force": fit.entry, "field_force": fit.field})


def learn_weights(calibration: Calibration, weighed: Weighed, source: str, say: Say) -> Calibration:
    """A calibration with the force, from known weights. source : of the session.

    Raises ConfigError if there are too few loads.
    """
    fit = fit_loads(*weighed)
    for words in force_words(fit, {}):
        say(words)
    entry = fit.entry.model_copy(update={"recordings": {public_address(source): 0.0}})
    return calibration.model_copy(update={"force": entry, "field_force": fit.field})
