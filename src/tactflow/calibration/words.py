"""How good a calibration is, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tactflow.calibration.file import DarknessEntry, DotsForceEntry, LinearForceEntry
from tactflow.calibration.force import Fit
from tactflow.calibration.known_loads import Gain
from tactflow.calibration.reference import LEAST_EXPLAINED, Reference
from tactflow.calibration.samples import fitting_core

CORE_TOLERANCE: Final = 0.03
"""Relative difference of two radii that is not worth a setting: the median of presses scatters by as much."""


def darkness_words(found: DarknessEntry) -> str:
    """The range and the error of a depth that was learned from darkening."""
    return (
        f"depth up to {found.depth[-1]:.2f} mm, where the gel is {100 * found.darkening[-1]:.0f} % darker; "
        f"standard error {found.stderr:.3f} mm"
    )


def photometric_words(errors: Mapping[str, float]) -> str:
    """The errors of a depth that was learned from colours, as in a `PhotometricEntry`.

    >>> photometric_words({"normal_error": 3.21, "depth_stderr": 0.1})
    'normals 3.2 degrees off in the mean, standard error of the depth 10 %'
    """
    return (
        f"normals {errors['normal_error']:.1f} degrees off in the mean, "
        f"standard error of the depth {100 * errors['depth_stderr']:.0f} %"
    )


def core_words(ratio: float, core: float) -> str:
    """How the core of contacts compares with the ball, and which setting fits. Arguments: `fitting_core`.

    >>> core_words(1.08, 0.8)
    'core_area: 1.08 times the radius where the gel leaves the ball; core: 0.90 below difference fits better'
    >>> core_words(1.02, 0.8)
    'core_area: 1.02 times the radius where the gel leaves the ball'
    """
    words = f"core_area: {ratio:.2f} times the radius where the gel leaves the ball"
    better = fitting_core(ratio, core)
    if abs(ratio - 1) > CORE_TOLERANCE and better != core:
        words += f"; core: {better:.2f} below difference fits better"
    return words


def gain_words(found: Gain, name: str) -> str:
    """What a calibration says of known loads. name : of its file."""
    loads = ", ".join(
        f"{said:.2f} +- {error:.2f} N for {known:.2f} N"
        for known, said, error in zip(found.known, found.said, found.errors, strict=True)
    )
    return f"{name} says {loads}: the loads are {found.value:.3f} +- {found.stderr:.3f} times what it says"


def force_words(fit: Fit, readings: Mapping[str, Reference]) -> list[str]:
    """What was learned about the force, and what not. readings : of the gauge, by recording."""
    entry = fit.entry
    words = [
        f"{name}: its clock is {offset.seconds:+.3f} +- {offset.stderr:.3f} s ahead of its CSV's, which is "
        "taken into account"
        for name, offset in fit.offsets.items()
        if offset.stderr > 0
    ]
    kind = "loads" if entry.left_out == "load" else "presses"
    by_dots = ", by the displacement of the dots"
    words.append(
        f"force{by_dots if entry.press is None else ''}, {entry.presses} {kind}: "
        f"{_quality(entry.pressing, entry.left_out)}"
    )
    if entry.pressing.r2 < LEAST_EXPLAINED:
        words.append(
            f"what the gel shows explains less than {100 * LEAST_EXPLAINED:.0f} % of the force: do not rely "
            "on it; press harder or with other loads, and see that these were the forces"
        )
    if entry.press is not None and "volume" not in entry.press.stiffness:
        words.append(
            "heights are not known, so the force is fitted to the change of light and the area: it is valid "
            "only for objects like these"
        )
    if fit.turned is not None:
        side = ", mirrored" if fit.mirrored else ""
        words.append(
            f"the gauge's x axis lies {fit.turned:+.0f} degrees counter-clockwise in the picture{side}"
        )
        if entry.drag is not None and "x" not in entry.dots:
            words.append(f"force sideways: {_quality(entry.drag, entry.left_out)}")
        words.extend(
            f"force along {axis}{by_dots}: {_quality(part, entry.left_out)}"
            for axis, part in entry.dots.items()
            if axis != "z"
        )
        if entry.drag is None and "x" not in entry.dots:
            words.append("fx and fy do not follow the flow of the contact, and are left out")
    elif any(reading.sideways for reading in readings.values()):
        words.append("fx and fy are left out: not every CSV has them")
    return words


def _quality(part: LinearForceEntry | DotsForceEntry, left_out: str) -> str:
    absolute, relative = part.error
    groups = {"object": "objects", "recording": "recordings", "press": "presses", "load": "loads"}[left_out]
    return (
        f"RMS error {part.rmse:.2f} N of {part.range[0]:.1f} to {part.range[1]:.1f} N, "
        f"{100 * part.r2:.0f} % of the variance explained, on {groups} left out of the fit; "
        f"standard error {absolute:.2f} N and {100 * relative:.0f} % of the force"
    )
