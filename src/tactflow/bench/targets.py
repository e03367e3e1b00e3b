"""What was promised of the default pipeline, and what a run of the bench says about it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from statistics import median

from tactflow.bench.gels import GELS, OUTLINES
from tactflow.bench.pipelines import ORIGINAL
from tactflow.bench.quantities import QUANTITIES
from tactflow.bench.results import RECORDING, Measurement, Result, Target
from tactflow.bench.scenes import NOMINAL, TROUBLES

DIRECTED = frozenset({"cable", "bright_cable", "edge"})
"""Scenes whose contacts are at least twice as long as wide."""

HARD_MARKERS = frozenset({"jumps", "jumps_worn"})
"""Scenes in which markers jump by nearly a pitch, or are worn away."""

ALWAYS = frozenset({"idle", "drift", "flicker", "noisy"})
"""Scenes that tempt a method to see contacts."""

_COUNTED = {f"{RECORDING}{name}" for name in ("sts_640", "sts_torque160", "handmade_dots", "wrs_cam1")}
"""Recordings with dots that are hard to find."""

MOST_GROWTH = 4.0
"""Promise: times as long as before that a frame of 4 times the pixels and markers takes at most."""


def judge(result: Result, default: str, growth: float | None, *, wedge: str, markerless: str) -> list[Target]:
    """Every promise with its result; those that were not measured say so.

    Parameters
    ----------
    result : of a run. default : name of the pipeline that made the promises. growth : from
        `pipelines.growth`. wedge, markerless : names of the pipelines for the real recordings with and
        without markers.
    """
    simulated = [m for m in result.of("pipeline", default) if not m.scene.startswith(RECORDING)]
    nominal = [m for m in simulated if m.scene in NOMINAL]
    return [
        *_times(result, nominal),
        *_marker_errors(simulated, nominal),
        *_contact_errors(simulated, nominal),
        _growth(growth),
        *_troubles(result, default, markerless),
        *_recordings(result, wedge, markerless),
        *_gels(result, default, markerless),
    ]


def _times(result: Result, nominal: Collection[Measurement]) -> list[Target]:
    script = {m.scene: m for m in result.of("pipeline", ORIGINAL)}
    copies = f"copies of a raw frame ({result.copy_ms:.3f} ms here)"
    return [
        _time("frame with contact", nominal, script, "contact", 8, 100, copies, worst=11),
        _time("frame without contact", nominal, script, "idle", 1.5, 150, copies),
    ]


def _marker_errors(simulated: Collection[Measurement], nominal: Collection[Measurement]) -> list[Target]:
    limits = [("displacement_rms", 0.03), ("displacement_p99", 0.1)]
    return [
        _worst("marker displacement: RMS; 99th percentile", nominal, limits),
        _wrong("identities", nominal, 0.1),
        _wrong("identities: jumps of 0.9 pitch; 5 % worn, missing", _of(simulated, HARD_MARKERS), 0.5),
    ]


def _contact_errors(simulated: Collection[Measurement], nominal: Collection[Measurement]) -> list[Target]:
    directed, tempting = _of(simulated, DIRECTED), _of(simulated, NOMINAL | ALWAYS)
    hull = [("hull_iou", 0.88), ("center_error", 1.0), ("area_error", 8.0)]
    flow = [("flow_error", 0.15)]
    decisions = [("false_contacts", 0.0), ("missed_half_depth", 0.0)]
    return [
        _worst("contact: hull IoU; centre; area", nominal, hull),
        _worst("direction: mean; maximum", directed, [("angle_mean", 0.7), ("angle_max", 2.5)]),
        _worst("mean flow in contact", nominal, flow),
        _worst("idle frames called contact; half-depth contacts missed", tempting, decisions),
    ]


def _growth(growth: float | None) -> Target:
    return Target(
        "4 times the pixels and markers",
        f"<= {MOST_GROWTH:g} times the time",
        "-" if growth is None else f"{growth:.2f} times",
        None if growth is None else growth <= MOST_GROWTH,
        "press, mirrored to twice its width and height",
    )


def _recordings(result: Result, wedge: str, markerless: str) -> list[Target]:
    ball = [("found_percent", 100.0), ("label_center_p50", 2.0), ("label_center_p95", 4.8)]
    roll = [("markers_short", 0.0), ("shared_dots", 0.0), ("flow_jumps", 0.0)]
    return [
        _recording(result, wedge, "wedge_ball", ball),
        _recording(result, wedge, "wedge_roll", roll),
        _tracker_time(result, wedge),
        _recording(result, markerless, "wedge_grasp", [("force_right", 98.0)]),
    ]


def _troubles(result: Result, default: str, markerless: str) -> list[Target]:
    """The scenes of `TROUBLES`, each with the pipeline for its gel."""
    names = {case.label for case in TROUBLES}
    found = [m for m in result.measurements if m.method in (default, markerless) and m.scene in names]
    return [
        _worst("real gels' troubles, simulated: outline", found, [("hull_iou", 0.9)]),
        _worst(
            "real gels' troubles, simulated: decisions",
            found,
            [("false_contacts", 0.0), ("missed_half_depth", 0.0)],
        ),
        _worst(
            "real gels' troubles, simulated: markers",
            found,
            [("markers_missed", 0.0), ("markers_false", 0.0)],
        ),
    ]


def _gels(result: Result, default: str, markerless: str) -> list[Target]:
    """Real gels of many labs, with the settings as they are shipped."""
    decisions = [("false_contacts", 0.5), ("missed_contacts", 2.0), ("early_found", 95.0)]
    dots = [("dots_found", 95.0), ("dots_beyond", 2.0)]
    counted = [m for m in result.of("pipeline", default) if m.scene in _COUNTED]
    names = {RECORDING + gel.folder for gel in GELS}
    if not any(m.scene in names for m in result.measurements):
        return [Target("real gels of many labs", "-", "-", None, "give the recordings with --data")]
    return [
        _recording(result, default, "franka_mini", decisions),
        _recording(result, default, "seu_a", [("false_contacts", 0.0)]),
        _recording(result, default, "sts_torque160", [("false_contacts", 0.0), ("missed_contacts", 5.0)]),
        _recording(result, default, "tactip_video", [("false_contacts", 0.0), ("missed_contacts", 0.0)]),
        _recording(result, default, OUTLINES, [("outline_iou_p50", 0.75), ("outline_iou_min", 0.5)]),
        _recording(result, default, "mini_ball", [("outline_iou_p50", 0.85), ("label_distance_p50", 1.5)]),
        _recording(result, markerless, "mini_box", [("line_angle_p50", 1.0), ("line_angle_max", 3.0)]),
        _recording(result, markerless, "9dtact_1", [("outline_iou_p50", 0.75)]),
        _recording(result, default, "simple_marks", [("outline_iou_p50", 0.75)]),
        _worst("dots found of those seen by eye", counted, dots),
    ]


def _of(measurements: Collection[Measurement], scenes: Collection[str]) -> list[Measurement]:
    return [m for m in measurements if m.scene in scenes]


def _number(value: float) -> str:
    return f"{value:.3g}"


def _time(
    name: str,
    measurements: Collection[Measurement],
    script: Mapping[str, Measurement],
    kind: str,
    most: float,
    faster: float,
    unit: str,
    *,
    worst: float | None = None,
) -> Target:
    """Judged by the median of the scenes, and by the dearest one if `worst` is given."""
    known = [m for m in measurements if kind in m.copies]
    ratios = [
        script[m.scene].copies[kind] / m.copies[kind]
        for m in known
        if m.scene in script and kind in script[m.scene].copies
    ]
    at_most = f", <= {worst:g} in each" if worst is not None else ""
    target = f"<= {most:g} {unit}{at_most}; >= {faster:g} times as fast as the original script"
    if not known or not ratios:
        return Target(name, target, "-", None)
    cost, dearest = median(m.copies[kind] for m in known), max(known, key=lambda m: m.copies[kind])
    highest = dearest.copies[kind]
    met = cost <= most and (worst is None or highest <= worst) and median(ratios) >= faster
    result = f"{cost:.1f} copies, {highest:.1f} at most; {median(ratios):.0f} times"
    return Target(name, target, result, met, f"median of {len(known)} scenes; most: {dearest.scene}")


def _worst(
    name: str,
    measurements: Collection[Measurement],
    limits: Collection[tuple[str, float]],
) -> Target:
    """Judged by the worst scene for each quantity."""
    wanted, got, where = [], [], []
    met: bool | None = None
    for key, bound in limits:
        quantity = QUANTITIES[key]
        higher = quantity.better == "higher"
        unit = f" {quantity.unit}" if quantity.unit else ""
        wanted.append(f"{'>=' if higher else '<='} {bound:g}{unit}")
        known = [m for m in measurements if key in m.errors]
        if not known:
            got.append("-")
            continue
        pick: Callable[..., Measurement] = min if higher else max
        worst = pick(known, key=lambda m: m.errors[key])
        value = worst.errors[key]
        got.append(_number(value))
        where.append(worst.scene)
        right = value >= bound if higher else value <= bound
        met = right if met is None else met and right
    scenes = len({m.scene for m in measurements})
    on = f"worst of {scenes} scenes: {', '.join(dict.fromkeys(where))}" if where else ""
    return Target(name, "; ".join(wanted), "; ".join(got), met, on)


def _wrong(name: str, measurements: Collection[Measurement], most: float) -> Target:
    """Wrong and lost markers together, judged by the worst scene."""
    sums = {
        m.scene: m.errors["wrong_percent"] + m.errors["lost_percent"]
        for m in measurements
        if "wrong_percent" in m.errors
    }
    target = f"<= {most:g} % wrong or lost"
    if not sums:
        return Target(name, target, "-", None)
    worst = max(sums, key=lambda scene: sums[scene])
    on = f"worst of {len(sums)} scenes: {worst}"
    return Target(name, target, f"{_number(sums[worst])} %", sums[worst] <= most, on)


def _recording(result: Result, method: str, scene: str, limits: Collection[tuple[str, float]]) -> Target:
    rows = [m for m in result.of("pipeline", method) if m.scene == RECORDING + scene]
    target = _worst(scene, rows, limits)
    titles = "; ".join(QUANTITIES[key].title for key, _ in limits)
    failure = next((m.failure for m in rows if m.failure), None)
    if failure is not None:
        return Target(scene, target.target, "failed", False, failure)
    on = titles if rows else "give the recordings with --data"
    return Target(scene, target.target, target.result, target.met, on)


def _tracker_time(result: Result, default: str) -> Target:
    rows = [m for m in result.of("pipeline", default) if m.scene == RECORDING + "wedge_roll"]
    times = [m.stages_ms["tracker"] for m in rows if "tracker" in m.stages_ms]
    if not times:
        return Target("wedge_roll, tracker", "<= 1 ms a frame", "-", None)
    return Target("wedge_roll, tracker", "<= 1 ms a frame", f"{times[0]:.2f} ms", times[0] <= 1.0, "median")
