"""Learn the probabilities of contacts and of dots from frames that a person labelled.

    python -m lab.probability contacts|dots --data RECORDINGS

Prints the weights for `tactflow.vision.contact.certainty` or `tactflow.vision.markers.selection`, and how
well probabilities are calibrated on labs that were left out of the fit.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from lab.judges import judge, judge_dots
from lab.judges.label_file import FrameLabel, load_labels
from tactflow.system.terminal import table
from tactflow.vision.arrays import Flags, Floats
from tactflow.vision.contact.certainty import contact_evidence
from tactflow.vision.markers import NoMarkersError, detect_markers

MIN_COVERED_SHARE: Final = 0.2
"""Minimum fraction of a region that the outline of its contact covers. Chosen by hand."""
RIDGE_PENALTY: Final = 0.5
"""Ridge penalty: without it, evidence that separates the places of few labs would get infinite weights."""
PROBABILITY_STEPS: Final = (0, 0.25, 0.5, 0.8, 0.9, 0.95, 0.99, 1)
"""Probabilities between which the truth is counted."""


def fit_probability(evidence: Floats, is_true: Flags) -> Floats:
    """Constant and weights (1 + k,) of the log odds, of evidence (n, k): logistic regression with a ridge."""
    design = np.column_stack([np.ones(len(is_true)), evidence])
    sign = np.where(is_true, -1.0, 1.0)

    def loss(weights: Floats) -> float:
        return float(
            np.logaddexp(0, sign * (design @ weights)).sum() + RIDGE_PENALTY * (weights[1:] ** 2).sum()
        )

    return np.asarray(minimize(loss, np.zeros(design.shape[1])).x, np.float64)


def fitted(labs: NDArray[np.str_], evidence: Floats, is_true: Flags) -> Iterator[str]:
    """The weights fitted to all labs; and how often what a fit to the others calls so probable is true.

    labs : (n,), of each place. evidence : (n, k). is_true : (n,).
    """
    yield f"constant and weights: {fit_probability(evidence, is_true).round(2).tolist()}"
    odds = np.zeros(len(labs))
    for left_out in np.unique(labs):
        others = labs != left_out
        weights = fit_probability(evidence[others], is_true[others])
        odds[~others] = weights[0] + evidence[~others] @ weights[1:]
    probability = 1 / (1 + np.exp(-odds))
    rows, error = [("called", "places", "are so")], 0.0
    for low, high in pairwise(PROBABILITY_STEPS):
        those = (probability > low) & (probability <= high)
        share = f"{100 * is_true[those].mean():.1f} %" if those.any() else "-"
        rows.append((f"{100 * low:.0f} to {100 * high:.0f} %", str(those.sum()), share))
        error += abs(float((probability[those] - is_true[those]).sum())) / len(labs)
    yield from table(rows)
    yield f"expected calibration error: {error:.3f}"


def contacts(pipeline: str, labels: Sequence[FrameLabel], data: Path) -> Iterator[str]:
    """The weights of a contact's probability, and how well it is calibrated."""
    labs, evidence, is_contact = [], [], []
    for label, result in judge.labelled(pipeline, labels, data):
        deviations = None if result is None else result.get("deviations")
        if result is None or result.contact_mask is None or not isinstance(deviations, np.ndarray):
            continue
        if not result.contacts:
            continue
        mask, truth = result.contact_mask, judge.outlined(label, result["mapping"])
        _, regions = cv2.connectedComponents(mask)
        for part in result.contacts:
            x, y = part.hull[0].astype(int)
            labs.append(label.lab)
            is_contact.append(np.mean(truth[regions == regions[y, x]] > 0) > MIN_COVERED_SHARE)
        evidence.append(contact_evidence(result.contacts, mask, deviations))
    if not evidence:
        raise SystemExit(f"--data {data}: has none of the labelled recordings")
    yield from fitted(np.array(labs), np.concatenate(evidence), np.array(is_contact))


def dots(labels: Sequence[FrameLabel], data: Path) -> Iterator[str]:
    """The weights of a dot's probability, and how well it is calibrated."""
    labs, evidences, are_dots = [], [], []
    for name, _, picture, marked, uncertain in judge_dots.labelled(
        labels, data, kinds=("", "half size", "JPEG 30")
    ):
        try:
            found = detect_markers(picture, least_probability=0.0)
        except NoMarkersError:
            continue
        if len(marked) and found.evidence is not None:
            which, inner = judge_dots.assign(
                found.centers, marked, uncertain, (picture.shape[1], picture.shape[0])
            )
            judged = inner & (which < len(marked))
            evidences.append(found.evidence[judged])
            are_dots.append(which[judged] >= 0)
            labs.append(np.full(judged.sum(), name))
    if not evidences:
        raise SystemExit(f"--data {data}: has none of the labelled recordings")
    yield from fitted(*map(np.concatenate, (labs, evidences, are_dots)))


def main() -> None:
    """Fit one of the two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("contacts", "dots"))
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="recordings that are labelled"
    )
    args = parser.parse_args()
    if args.what == "dots":
        print(*dots(load_labels(judge_dots.DOTS), args.data), sep="\n")
    else:
        labels = [label for label in load_labels(judge.OUTLINES) if label.round == 1]
        print(*contacts("default", labels, args.data), sep="\n")


if __name__ == "__main__":
    main()
