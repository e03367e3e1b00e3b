"""The numbers and the picture of label-limits.md: how well hand labels can be met.

    python docs/label_limits.py [FOLDER]

FOLDER holds the recordings `wedge_ball` and `gels/mini_ball`; without it, `../shared/data` beside the
repository. Prints the tables and writes label-limits.svg beside this file. Takes half a minute.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.recordings import RECTIFY
from tactflow.vision.contact import ContactDetector
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import find_dot, marker_mask

Values = NDArray[np.float64]

TARGETS = (2.0, 4.8)
WINDOW = 26
"""Half the side of the window in which a picture is compared with its own point reflection, px."""
REACH = 8
"""How far from the outline's centre the centre of reflection is sought, px."""
DRAWS = 4000
WRONG = "051"
"""A label of `mini_ball` that is 70 px beside the ball."""
SIDE, MARGIN, RANGE = 380, 50, 8.0


def read(folder: Path) -> tuple[list[NDArray[np.uint8]], Values]:
    """The rectified pictures, the untouched gel first, and the labelled centres, (N, 2) px."""
    with (folder / "labels.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    corners: dict[str, Any] = {**RECTIFY}
    rectify = Preprocessor((240, 320), homography=(corners["from"], corners["to"], corners["size"]))
    files = [folder / "reference.jpg", *(folder / row["file"] for row in rows)]
    pictures = [rectify(np.asarray(cv2.imread(str(file)), np.uint8)) for file in files]
    return pictures, np.array([(float(row["x"]), float(row["y"])) for row in rows])


def read_mini(folder: Path) -> tuple[list[NDArray[np.uint8]], Values]:
    """The pictures of `mini_ball`, the untouched gel first, and the labelled centres, (N, 2) px."""
    labels = json.loads((folder / "labels.json").read_text(encoding="utf-8"))
    names = [name for name in sorted(labels) if name != WRONG]
    pictures = [np.asarray(cv2.imread(str(folder / f"{name}.png")), np.uint8) for name in ["000", *names]]
    return pictures, np.array([labels[name]["center"] for name in names], np.float64)


def by_outline(pictures: list[NDArray[np.uint8]], masks: list[NDArray[np.uint8]]) -> Values:
    """(N, 2) px: centroid of the contact region, as the default pipeline finds it."""
    detector = ContactDetector()
    detector.add_reference(pictures[0])
    centers = []
    for picture, mask in zip(pictures[1:], masks[1:], strict=True):
        contact = contact_geometry(detector.detect(picture, mask).mask, min_area=20)
        centers.append((np.nan, np.nan) if contact is None else contact.center)
    return np.array(centers)


def by_reflection(pictures: list[NDArray[np.uint8]], start: Values) -> Values:
    """(N, 2) px: centre about which the change of colour is most nearly the negative of its own reflection.

    A ball's slopes at two opposite places are opposite, and so are the changes of light that they make; no
    outline, no threshold.
    """
    reference = pictures[0].astype(np.float32)
    offset = np.mgrid[-WINDOW : WINDOW + 1, -WINDOW : WINDOW + 1]
    weight = np.exp(-(offset**2).sum(axis=0) / (2 * (WINDOW / 2) ** 2)).astype(np.float32)
    size = (2 * WINDOW + 1, 2 * WINDOW + 1)
    centers = []
    for picture, (x, y) in zip(pictures[1:], np.rint(start), strict=True):
        change = cv2.GaussianBlur((picture - reference) / (reference + 15), (0, 0), 1.5)
        change -= np.median(change.reshape(-1, 3), axis=0)
        likeness = np.zeros((2 * REACH + 1, 2 * REACH + 1))
        for row, column in np.ndindex(likeness.shape):
            place = (float(x + column - REACH), float(y + row - REACH))
            for channel in cv2.split(change):
                patch = cv2.getRectSubPix(channel, size, place)
                likeness[row, column] += float((weight * patch * patch[::-1, ::-1]).sum())
        row, column = (int(index) for index in np.unravel_index(np.argmin(likeness), likeness.shape))
        row, column = np.clip((row, column), 1, 2 * REACH - 1)
        down = vertex(likeness[row - 1 : row + 2, column])
        across = vertex(likeness[row, column - 1 : column + 2])
        centers.append((x + column - REACH + across, y + row - REACH + down))
    return np.array(centers)


def vertex(values: Values) -> float:
    """Where the parabola through three equidistant values has its extremum, from the middle one."""
    return float(0.5 * (values[0] - values[2]) / (values[0] - 2 * values[1] + values[2]))


def errors(centers: Values, labels: Values) -> Values:
    """(N, 2) px: against the labels, after their median offset, as the bench judges."""
    found = centers - labels
    return np.asarray(found - np.nanmedian(found, axis=0))


def summed_up(found: Values) -> str:
    """Median and 95th percentile of the distances."""
    distance = np.hypot(*found.T)
    return f"{np.nanmedian(distance):.2f} | {np.nanpercentile(distance, 95):.2f}"


def svg(first: Values, second: Values) -> str:
    """Errors of the two methods against each other, x on the left, y on the right."""
    width, height = 2 * (SIDE + MARGIN) + MARGIN, SIDE + 2 * MARGIN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
    ]
    for axis, name in enumerate("xy"):
        left, top = MARGIN + axis * (SIDE + MARGIN), MARGIN / 2
        parts.append(f'<rect x="{left}" y="{top}" width="{SIDE}" height="{SIDE}" fill="none" stroke="#aaa"/>')
        parts.append(f'<path d="M{left} {top + SIDE}L{left + SIDE} {top}" stroke="#bbb"/>')
        for tick in (-8, -4, 0, 4, 8):
            along = SIDE * (tick / RANGE + 1) / 2
            parts.append(
                f'<text x="{left + along}" y="{top + SIDE + 16}" text-anchor="middle">{tick}</text>'
                f'<text x="{left - 6}" y="{top + SIDE - along + 4}" text-anchor="end">{tick}</text>'
            )
        for one, other in np.clip(np.stack([first[:, axis], second[:, axis]], axis=1), -RANGE, RANGE):
            x, y = left + SIDE * (one / RANGE + 1) / 2, top + SIDE * (1 - (other / RANGE + 1) / 2)
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="#1f4e79" fill-opacity="0.6"/>')
        parts.append(
            f'<text x="{left + SIDE / 2}" y="{top + SIDE + 36}" text-anchor="middle">'
            f"outline minus label, {name}, px (up: reflection minus label)</text>"
        )
    return "\n".join([*parts, "</svg>", ""])


def both_ways(pictures: list[NDArray[np.uint8]]) -> tuple[Values, Values]:
    """Centres (N, 2) px by the outline and by reflection; the untouched gel is the first picture."""
    dot = find_dot(pictures[0])
    assert dot is not None
    masks = [marker_mask(picture, dot) for picture in pictures]
    unmarked = [remove_markers(picture, mask) for picture, mask in zip(pictures, masks, strict=True)]
    outline = by_outline(unmarked, masks)
    return outline, by_reflection(unmarked, outline)


def shared_variance(first: Values, second: Values) -> Values:
    """(2,) px^2: covariance of the errors of both ways, along x and along y."""
    return np.array([np.cov(first[:, axis], second[:, axis])[0, 1] for axis in (0, 1)])


def mini_ball(folder: Path) -> None:
    """Print the numbers of `mini_ball`, whose promise has no offset taken out."""
    pictures, labels = read_mini(folder)
    outline, reflection = both_ways(pictures)
    for name, centers in (("outline", outline), ("reflection", reflection)):
        found = centers - labels
        offset = np.median(found, axis=0)
        print(
            f"mini_ball, {name}: {summed_up(found)}, offset {offset.round(2)}, "
            f"without it {summed_up(found - offset)}"
        )
    shared = shared_variance(errors(outline, labels), errors(reflection, labels))
    draws = np.random.default_rng(0).normal(size=(DRAWS, len(labels), 2)) * np.sqrt(shared)
    for offset in (np.zeros(2), np.median(outline - labels, axis=0)):
        median = np.median(np.hypot(*(draws + offset).transpose(2, 0, 1)))
        print(
            f"labels: {np.sqrt(shared).round(2)} px; offset {offset.round(2)}: no better than {median:.2f} px"
        )


def main() -> None:
    """Print the table and write the picture."""
    here = Path(__file__).resolve()
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else here.parents[2] / "shared" / "data"
    pictures, labels = read(data / "wedge_ball")
    outline, reflection = both_ways(pictures)
    first, second = errors(outline, labels), errors(reflection, labels)
    print("| | median | 95th percentile |\n| --- | --- | --- |")
    print(f"| target | {TARGETS[0]:g} | {TARGETS[1]:g} |")
    print(f"| outline against labels | {summed_up(first)} |")
    print(f"| reflection against labels | {summed_up(second)} |")
    print(f"| outline against reflection | {summed_up(errors(outline, reflection))} |")
    shared = shared_variance(first, second)
    draws = np.random.default_rng(0).normal(size=(DRAWS, len(labels), 2)) * np.sqrt(shared)
    distance = np.hypot(draws[..., 0], draws[..., 1])
    medians, tails = np.median(distance, axis=1), np.percentile(distance, 95, axis=1)
    print(f"| a method without any error | {np.median(medians):.2f} | {np.median(tails):.2f} |")
    for name, values, target in zip(("median", "95th percentile"), (medians, tails), TARGETS, strict=True):
        low, high = np.percentile(values, [5, 95])
        met = 100 * np.mean(values <= target)
        print(f"{name} of a method without error: {low:.2f} to {high:.2f}; within the target in {met:.0f} %")
    both = 100 * np.mean((medians <= TARGETS[0]) & (tails <= TARGETS[1]))
    own = [np.var(errors[:, axis]) - shared[axis] for errors in (first, second) for axis in (0, 1)]
    print(
        f"both in {both:.0f} %; labels: {np.sqrt(shared).round(2)} px; outline, reflection: "
        f"{np.sqrt(np.maximum(own, 0)).round(2)} px"
    )
    here.with_name("label-limits.svg").write_text(svg(first, second), encoding="utf-8")
    mini_ball(data / "gels" / "mini_ball")


if __name__ == "__main__":
    main()
