"""The quantities the bench measures: name, unit, which way is better, and how far a rerun may stray."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Quantity:
    """One measured error.

    key : name in bench.json. title : for people. unit : "" for none.
    better : which direction is better. best : the perfect value, from which plots measure the error.
    slack, share : a stored result may be exceeded by slack + share * |stored| before `--against` calls it
        worse. Slack covers what other CPUs change in the last bits of floating-point sums (a marker or a
        pixel at a threshold falls to the other side); share keeps the rule sensible for large errors. For
        shares of frames, slack is a little more than one frame of the quick run's 30.
    """

    key: str
    title: str
    unit: str
    better: Literal["lower", "higher"] = "lower"
    best: float = 0.0
    slack: float = 0.0
    share: float = 0.1

    def distance(self, value: float) -> float:
        """Distance from the perfect value, >= 0; what plots show."""
        return abs(value - self.best)

    def allowed(self, stored: float) -> float:
        """The worst value that still counts as no worse than `stored`."""
        margin = self.slack + self.share * self.distance(stored)
        return stored + margin if self.better == "lower" else stored - margin

    def is_worse(self, value: float, stored: float) -> bool:
        """True if `value` is worse than `stored` by more than the tolerance."""
        allowed = self.allowed(stored)
        return value > allowed if self.better == "lower" else value < allowed


_ALL = [
    Quantity("displacement_rms", "marker displacement error, RMS", "px", slack=0.004),
    Quantity("displacement_p99", "marker displacement error, 99th percentile", "px", slack=0.02),
    Quantity("wrong_percent", "markers with a wrong identity", "%", slack=0.05),
    Quantity("lost_percent", "visible markers declared lost", "%", slack=0.1),
    Quantity("markers_missed", "markers never found", "", slack=0.5),
    Quantity("markers_false", "what was taken for a marker and is none", "", slack=0.5),
    Quantity("marker_recall", "markers found (recall)", "", better="higher", best=1.0, slack=0.005),
    Quantity("marker_precision", "detections that are markers (precision)", "", "higher", 1.0, slack=0.005),
    Quantity("localisation_rms", "detected centre against true centre, RMS", "px", slack=0.01),
    Quantity("contact_iou", "contact mask, IoU with the truth", "", "higher", 1.0, slack=0.01),
    Quantity("hull_iou", "contact hull, IoU with the true hull", "", "higher", 1.0, slack=0.01),
    Quantity("area_error", "hull area error, mean", "%", slack=0.5),
    Quantity("center_error", "contact centre error, mean", "px", slack=0.05),
    Quantity("angle_mean", "direction error, mean", "deg", slack=0.05),
    Quantity("angle_max", "direction error, maximum", "deg", slack=0.3),
    Quantity("angle_missing", "frames with a direction where none was given", "%", slack=4.0),
    Quantity("angle_invented", "round contacts that were given a direction", "%", slack=4.0),
    Quantity("flow_error", "mean flow of the gel in contact, error, mean", "px", slack=0.02),
    Quantity("flow_rms", "mean flow of the gel in contact, error, RMS", "px", slack=0.02),
    Quantity("flow_within_one", "mean-flow errors within one stderr", "%", "higher", 68.0, slack=15.0),
    Quantity("flow_within_two", "mean-flow errors within two stderr", "%", "higher", 95.0, slack=5.0),
    Quantity("depth_rms", "heights, RMS error over the greatest depth", "%", slack=0.3),
    Quantity("depth_within_one", "greatest-depth errors within one stderr", "%", "higher", 68.0, slack=15.0),
    Quantity("depth_within_two", "greatest-depth errors within two stderr", "%", "higher", 95.0, slack=5.0),
    Quantity("field_rms", "displacement of the gel in contact, error of a component, RMS", "px", slack=0.05),
    Quantity("field_within_one", "displacement errors within one stderr", "%", "higher", 68.0, slack=15.0),
    Quantity("field_within_two", "displacement errors within two stderr", "%", "higher", 95.0, slack=5.0),
    Quantity("slip_onset", "slip said too late or too early, worst", "frames", slack=1.0),
    Quantity("slip_missed", "slips that were not said", "%", slack=0.0),
    Quantity("slip_false", "frames called slip of contacts that stick", "%", slack=0.0),
    Quantity("volume_error", "indented volume, error, mean", "%", slack=1.0),
    Quantity("normal_error", "normals of a ball, mean angle", "deg", slack=0.3),
    Quantity("ball_radius_error", "radius of a ball from its heights, median", "%", slack=0.5),
    Quantity("sphere_rms", "heights of a ball, RMS from a sphere", "mm", slack=0.003),
    Quantity("false_contacts", "idle frames called contact", "%", slack=0.0),
    Quantity("missed_contacts", "frames with contact missed", "%", slack=4.0),
    Quantity("missed_half_depth", "contact at half depth or more missed", "%", slack=0.0),
    Quantity("inpaint_mae", "marker removal, mean absolute error in the mask", "grey levels", slack=0.1),
    Quantity("inpaint_psnr", "marker removal, PSNR in the mask", "dB", "higher", 100.0, slack=0.3, share=0.0),
    Quantity("found_percent", "labelled contacts found", "%", "higher", 100.0),
    Quantity("label_center_p50", "centre against hand label, median", "px", slack=0.1),
    Quantity("label_center_p95", "centre against hand label, 95th percentile", "px", slack=0.3),
    Quantity("outline_iou_p50", "outline by eye, IoU, median", "", "higher", 1.0, slack=0.02),
    Quantity("outline_iou_min", "outline by eye, IoU, worst", "", "higher", 1.0, slack=0.05),
    Quantity("label_distance_p50", "centre against labelled circle, median", "px", slack=0.1),
    Quantity("line_angle_p50", "direction against labelled line, median", "deg", slack=0.1),
    Quantity("line_angle_max", "direction against labelled line, maximum", "deg", slack=0.3),
    Quantity("early_found", "first contacts within a second that were seen in time", "%", "higher", 100.0),
    Quantity("dots_found", "dots found, of those seen by eye", "%", "higher", 100.0, slack=1.0),
    Quantity("dots_beyond", "dots found beyond those seen by eye", "%", slack=1.0),
    Quantity("force_right", "contact agrees with force >= 0.75 N", "%", "higher", 100.0, slack=0.3),
    Quantity("shared_dots", "markers that share a dot with another", "per frame", slack=0.0),
    Quantity("flow_jumps", "flow jumps over half a pitch against neighbours", "per frame", slack=0.0),
    Quantity("frames_with_jumps", "frames with at least one flow jump", "%", slack=0.0),
    Quantity("lost_share", "markers declared lost on a real roll", "%", slack=0.2),
    Quantity("markers_short", "markers missing from the known grid", "", slack=0.0),
]

QUANTITIES: Mapping[str, Quantity] = {quantity.key: quantity for quantity in _ALL}
"""Every quantity by its key."""


def format_number(value: float) -> str:
    """Three significant digits without an exponent where it stays readable."""
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e5:
        return f"{value:.1e}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text
