"""Judge where an object is, and how it has been moved, against a robot that knows it.

    python -m benchmarks.places [--data ../shared/data]

`letac`: two objects, gripped and then dragged by a robot. A plane is fitted from the features to the robot's
x and y (mm) on every other grasp, and tested on the rest: correlation and RMS residual for x, y. Features are
the centre of the contact, the mean flow inside it, or both. The grip drags the gel along, which shows in the
flow, and the object slides, which shows in the centre.

`tactip_shear`: a flat surface, pushed in, tilted, sheared and turned in separate pictures. A linear model
(ridge regression; its weight by leave-one-out errors of the training half) from every second picture to the
rest: mean absolute error, of displacements of the tracked dots, of the density of all dots on a grid, which
needs no dot's identity, and of chance (the mean of the other half).
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

import tactflow
from tactflow.message.result import Result
from tactflow.system.terminal import show, table
from tactflow.vision.arrays import Floats
from tactflow.vision.types import MarkerStatus

OBJECTS = ("3D_printing_1", "gel")
FEATURES = {"centre": slice(0, 2), "flow": slice(2, 4), "both": slice(0, 4)}
"""Columns of `look`."""
MOVED = {
    **{"pose_z": "mm", "pose_Rx": "deg", "pose_Ry": "deg"},
    **{"shear_x": "mm", "shear_y": "mm", "shear_Rz": "deg"},
}
"""Column of tactip_shear -> its unit."""
BLUR, CELLS = 6.0, 42
"""Of the density of dots: standard deviation, px, and cells along a side of its grid."""


def results(pictures: list[Path], untouched: Path, name: str = "default") -> Iterator[Result]:
    """The results of separate pictures, each against the untouched gel."""
    with TemporaryDirectory() as folder:
        for number, path in enumerate(pictures):
            (Path(folder) / f"{number:04d}{path.suffix}").symlink_to(path.resolve())
        settings = {
            "stages.preprocess.rotate": 0,
            "stages.preprocess.downsample": 1,
            "stages.capture.reference": str(untouched),
            "stages.capture.settle": 0,
            "sinks.view": None,
        }
        pipeline = replace(tactflow.load(name, source=folder, settings=settings), skipping=False)
        yield from (result for result in tactflow.stream(pipeline) if result.seq >= 0)


def look(result: Result) -> list[float]:
    """Centre and flow, px; NaN where they are not known."""
    unknown = (np.nan, np.nan)
    center = unknown if result.contact is None else result.contact.center
    flow = unknown if result.flow is None or result.flow.mean is None else result.flow.mean
    return [*center, *flow]


def densities(dots: list[Floats], size: tuple[int, int]) -> Floats:
    """(n, k): how many dots of (N, 2) px lie about each place of a grid. size : (width, height), px."""
    fields = []
    for points in dots:
        picture = np.zeros(size[::-1], np.float32)
        inside = ((points >= 0) & (points < np.array(size) - 0.5)).all(axis=1)
        columns, rows = np.rint(points[inside]).astype(int).T
        np.add.at(picture, (rows, columns), 1)
        blurred = cv2.GaussianBlur(picture, (0, 0), BLUR)
        fields.append(cv2.resize(blurred, (CELLS, CELLS), interpolation=cv2.INTER_AREA).ravel())
    return np.array(fields, float)


def ridge(features: Floats, values: Floats, tested: Floats) -> Floats:
    """Prediction of a ridge regression for `tested`; one value at a time, its weight by leave-one-out."""
    middle = features.mean(axis=0)
    left, size, right = np.linalg.svd(features - middle, full_matrices=False)
    mean = values.mean(axis=0)
    predicted = np.tile(mean, (len(tested), 1))
    for column, target in enumerate((values - mean).T):
        fits = []
        for weight in size[0] ** 2 * np.logspace(-9, 0, 19):
            shrunk = size**2 / (size**2 + weight)
            leverage = (left**2) @ shrunk + 1 / len(left)
            residual = (target - left @ (shrunk * (left.T @ target))) / (1 - leverage)
            fits.append((float(residual @ residual), weight))
        slopes = right.T @ (size / (size**2 + min(fits)[1]) * (left.T @ target))
        predicted[:, column] += (tested - middle) @ slopes
    return predicted


def judge_shear(folder: Path) -> list[list[str]]:
    """Rows: the features, and the mean absolute error of each number of the robot."""
    lines = list(csv.DictReader((folder / "labels.csv").read_text().splitlines()))
    true = np.array([[float(line[name]) for name in MOVED] for line in lines])
    # The picture with the least motion comes first: the dots of all others are compared with it.
    rest = int(np.argmin(((true - true.mean(axis=0)) ** 2 / true.var(axis=0)).sum(axis=1)))
    paths = [folder / line["image"] for line in lines]
    found = [r.markers for r in results(paths, paths[rest], "tactip") if r.markers is not None]
    displaced = np.array([(dots.position - dots.origin).ravel() for dots in found])
    tracked = [dots.position[dots.status == MarkerStatus.TRACKED] for dots in found]
    height, width = cv2.imread(str(paths[0])).shape[:2]
    learned = slice(0, None, 2), slice(1, None, 2)
    rows = [["tactip_shear", *(f"{name}, {unit}" for name, unit in MOVED.items())]]
    tested = true[learned[1]]
    predicted = {
        what: ridge(features[learned[0]], true[learned[0]], features[learned[1]])
        for what, features in (
            ("displacements", displaced),
            ("density", densities(tracked, (width, height))),
        )
    }
    predicted["chance"] = np.tile(true[learned[0]].mean(axis=0), (len(tested), 1))
    for what, values in predicted.items():
        rows.append([what, *(f"{error:.2f}" for error in np.abs(values - tested).mean(axis=0))])
    return rows


def judge(features: Floats, true: Floats, grasps: list[str]) -> list[str]:
    """Columns of a row. features : (n, k). true : (n, 2), mm. grasps : (n,), whose pictures stay together."""
    known = np.isfinite(features).all(axis=1)
    tested = np.isin(grasps, sorted(set(grasps))[1::2])
    plane = np.column_stack([features, np.ones(len(features))])
    fit = np.linalg.lstsq(plane[known & ~tested], true[known & ~tested], rcond=None)[0]
    predicted, true = plane[known & tested] @ fit, true[known & tested]
    correlation = [np.corrcoef(predicted[:, axis], true[:, axis])[0, 1] for axis in (0, 1)]
    residual = np.sqrt(((predicted - true) ** 2).mean(axis=0))
    return [
        "{:.2f} {:.2f}".format(*correlation),
        "{:.2f} {:.2f}".format(*residual),
        f"{np.count_nonzero(known & tested)} of {np.count_nonzero(tested)}",
    ]


def main() -> None:
    """Judge every object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    data = parser.parse_args().data
    folder = data / "letac"
    lines = list(csv.DictReader((folder / "labels.csv").read_text().splitlines()))
    untouched = min((folder / "empty").iterdir())
    rows = [["letac", "from", "correlation", "residual, mm", "pictures"]]
    for name in OBJECTS:
        chosen = [line for line in lines if line["image"].startswith(f"{name}/")]
        paths = [folder / line["image"] for line in chosen]
        features = np.array([look(result) for result in results(paths, untouched)])
        true = np.array([[float(line["x_mm"]), float(line["y_mm"])] for line in chosen])
        grasps = [path.stem.rpartition("_")[0] for path in paths]
        rows += [
            [name, what, *judge(features[:, columns], true, grasps)] for what, columns in FEATURES.items()
        ]
    show([*table(rows), "", *table(judge_shear(data / "tactip_shear"))])


if __name__ == "__main__":
    main()
