"""Judge where an object is, and how it has been moved, against a robot that knows it.

    python -m lab.places [--data ../shared/data]

`letac`: two objects, gripped and then dragged by a robot. A plane is fitted from the features to the robot's
x and y (mm) on every other grasp, and tested on the rest: correlation and RMS residual for x, y. Features are
the centre of the contact, the mean flow inside it, or both. The grip drags the gel along, which shows in the
flow, and the object slides, which shows in the centre.

`tactip_shear`: a flat surface, pushed in, tilted, sheared and turned in separate pictures. From every second
picture to the rest: mean absolute error of a linear model of displacements of the tracked dots (ridge
regression), of a nonlinear one of the blurred picture, which needs no dot's identity (kernel ridge), and of
chance (the mean of the other half). All weights are chosen by leave-one-out errors of the training half.
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

OBJECTS = ("3D_printing_1", "gel")
FEATURES = {"centre": slice(0, 2), "flow": slice(2, 4), "both": slice(0, 4)}
"""Columns of `look`."""
MOVED = {
    **{"pose_z": "mm", "pose_Rx": "deg", "pose_Ry": "deg"},
    **{"shear_x": "mm", "shear_y": "mm", "shear_Rz": "deg"},
}
"""Column of tactip_shear -> its unit."""
BLUR, CELLS, COMPONENTS = 6.0, 28, 20
"""Of the blurred picture: standard deviation, px, cells along a side, and principal components."""


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


def blurred(path: Path) -> Floats:
    """(k,): the picture so coarse that single dots do not show, but how dense they are everywhere."""
    grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.float32)
    coarse = cv2.resize(cv2.GaussianBlur(grey, (0, 0), BLUR), (CELLS, CELLS), interpolation=cv2.INTER_AREA)
    return np.asarray(coarse, np.float64).ravel()


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


def kernel_ridge(features: Floats, values: Floats, tested: Floats) -> Floats:
    """As `ridge`, with a Gaussian kernel of principal components, whose width is also by leave-one-out.

    References
    ----------
    C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, eq. 2.25 and 5.12.
    """
    middle, mean = features.mean(axis=0), values.mean(axis=0)
    axes = np.linalg.svd(features - middle, full_matrices=False)[2][:COMPONENTS].T
    known, asked = (features - middle) @ axes, (tested - middle) @ axes
    apart, away = (((part[:, None] - known) ** 2).sum(axis=2) for part in (known, asked))
    predicted = np.tile(mean, (len(tested), 1))
    least = np.full(values.shape[1], np.inf)
    for width in np.median(apart) * np.logspace(-0.5, 1.5, 5):
        spectrum, vectors = np.linalg.eigh(np.exp(-apart / (2 * width)))
        for weight in np.logspace(-6, -1, 6):
            inverse = (vectors / (spectrum + weight)) @ vectors.T
            slopes = inverse @ (values - mean)
            errors = ((slopes / np.diag(inverse)[:, None]) ** 2).sum(axis=0)
            better = errors < least
            least[better] = errors[better]
            predicted[:, better] = (mean + np.exp(-away / (2 * width)) @ slopes)[:, better]
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
    learned = slice(0, None, 2), slice(1, None, 2)
    rows = [["tactip_shear", *(f"{name}, {unit}" for name, unit in MOVED.items())]]
    tested = true[learned[1]]
    predicted = {
        what: method(features[learned[0]], true[learned[0]], features[learned[1]])
        for what, method, features in (
            ("displacements", ridge, displaced),
            ("blurred picture", kernel_ridge, np.array([blurred(path) for path in paths])),
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
