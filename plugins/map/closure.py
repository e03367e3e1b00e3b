"""Loop closure: keyframes that show the same part of the object again are registered with each other.

Reference: H.-J. Huang, M. A. Mirzaee, M. Kaess, W. Yuan, "GelSLAM: A Real-time, High-Fidelity, and Robust 3D
Tactile SLAM System", arXiv 2508.15990, for keyframes and loops from the registration of normals. There, loops
are found by image features; here, by the places that the pose graph predicts, and a statistical test.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.stats import chi2, f

from tactflow.vision.arrays import Floats
from tactflow.vision.pose.align import align
from tactflow.vision.pose.imprint import Template
from tactflow.vision.pose.rigid import adjoint, inverse, rigid, vector
from tactflow.vision.pose.tracker import MAX_MISFIT, MAX_RESIDUAL, SLOPE_ERROR_PARTS

from .graph import Graph, optimised, spanning, twist
from .keyframes import Edge, Keyframe, about_origin, overlap, turned

MIN_OVERLAP: Final = 0.5
"""Smallest share of a patch that another one shows, for them to be registered."""
FALSE_REJECTION_RATE: Final = 1e-3
"""Share of true loops that the test rejects."""
MAX_CONTRADICTION: Final = float(chi2.isf(FALSE_REJECTION_RATE, 6))
"""Largest squared distance of a loop from the graph, in standard errors."""
SEARCH_STDERRS: Final = 2.0
"""How far from the predicted motion the search begins, in its standard errors."""
MAX_STARTS: Final = 30
"""Largest number of first guesses on either side."""
MISFIT_FREEDOM: Final = 44
"""Degrees of freedom of a misfit: see `MAX_MISFIT`."""
MAX_MISFIT_RATIO: Final = float(f.isf(0.05, MISFIT_FREEDOM, MISFIT_FREEDOM))
"""Misfit over that of the best motion up to which another one fits as well: the F test, 5 %."""
MAX_LOOPS: Final = 5
"""Earlier keyframes with which one is registered in a round, at most: those that show most of its patch."""
MAX_ROUNDS: Final = 5
"""Rounds of finding loops, and of joining contacts; each may find more, as more is known after the last."""


def mapped(keyframes: Sequence[Keyframe], edges: Sequence[Edge], *, loops: bool = True) -> Graph:
    """Where the object was in each keyframe.

    keyframes, edges : of a contact. loops : whether to look for parts of the object that are touched again.
    The anchor is the keyframe with the largest patch, to which all others are compared.
    """
    anchor = int(np.argmax([keyframe.imprint.area for keyframe in keyframes]))
    slope_stderr = float(np.sqrt(np.mean([keyframe.imprint.error**2 for keyframe in keyframes])))
    graph = optimised(spanning(edges, anchor), edges, anchor, slope_stderr)
    tried: set[tuple[int, int]] = set()
    accepted: list[Edge] = []
    for _ in range(MAX_ROUNDS if loops else 0):
        pairs = [pair for pair in _overlapping(keyframes, graph) if pair not in tried]
        tried.update(pairs)
        found = [_loop(keyframes, graph, *pair) for pair in pairs]
        new = [edge for edge in found if edge is not None]
        if not new:
            break
        accepted += new
        graph = optimised(graph.poses, [*edges, *weakened(accepted)], anchor, slope_stderr, graph.slope_error)
    return graph


def weakened(loops: Sequence[Edge]) -> list[Edge]:
    """Loops without the information that those of the same patch have in common, which is counted once."""
    uses = Counter(index for loop in loops for index in (loop.before, loop.now))
    return [
        loop._replace(covariance=loop.covariance * max(uses[loop.before], uses[loop.now])) for loop in loops
    ]


def _overlapping(keyframes: Sequence[Keyframe], graph: Graph) -> list[tuple[int, int]]:
    """Pairs of keyframes, no neighbours, that show the same part of the object, by the graph."""
    backs = [inverse(pose) for pose in graph.poses]
    middles = np.array(
        [back[:3, :3] @ key.template.center + back[:3, 3] for key, back in zip(keyframes, backs, strict=True)]
    )
    reach = [float(np.abs(key.template.points[:, :2]).max()) for key in keyframes]
    pairs = []
    for now, keyframe in enumerate(keyframes):
        far = np.linalg.norm(middles[: max(now - 1, 0)] - middles[now], axis=1)
        near = np.flatnonzero(far < reach[now] + np.array(reach[: len(far)])).tolist()
        shared = {
            i: overlap(keyframes[i].imprint, keyframe.template, graph.poses[i] @ backs[now]) for i in near
        }
        best = sorted(near, key=lambda i, shared=shared: -shared[i])[:MAX_LOOPS]  # type: ignore[misc]
        pairs += [(i, now) for i in best if shared[i] >= MIN_OVERLAP]
    return pairs


def _loop(keyframes: Sequence[Keyframe], graph: Graph, before: int, now: int) -> Edge | None:
    """The registered motion between two keyframes; None where they do not match, or contradict the graph.

    Where several motions fit as well as the best one, their scatter is part of the error: a rod with a
    regular thread may be turned by any angle.
    """
    found, covariance = [], graph.covariance(before, now)
    for start in _starts(keyframes[before].template, graph.motion(before, now, covariance)):
        registration = registered(keyframes, before, now, start)
        if registration is not None:
            misfit, edge = registration
            found.append((misfit, graph.contradiction(edge, covariance), edge))
    if not found:
        return None
    misfit, contradiction, best = min(found, key=lambda one: one[0] + one[1])
    if misfit > MAX_MISFIT or contradiction > MAX_CONTRADICTION:
        return None
    others = [edge for other, _, edge in found if other < misfit * MAX_MISFIT_RATIO]
    away = np.array([twist(edge.motion @ inverse(best.motion)) for edge in others])
    return best._replace(covariance=best.covariance + away.T @ away / len(away))


def _starts(template: Template, predicted: Edge) -> list[Floats]:
    """First guesses (4, 4) on both sides of a predicted motion, along the uncertainty that changes
    normals and places most: in steps as large as the deviation of the normals over the template, and as that
    of its points along its narrow side."""
    there = np.eye(4)
    there[:3, 3] = template.center
    carry = adjoint(inverse(there)) @ adjoint(inverse(predicted.motion))
    values, axes = np.linalg.eigh(carry @ predicted.covariance @ carry.T)
    root = axes * np.sqrt(np.maximum(values, 0))
    change = template.by[:, :2].reshape(-1, 6) / template.signal
    width = np.linalg.eigvalsh(np.cov(template.points[:, :2].T))[0]
    squares, directions = np.linalg.eigh(
        root.T @ (change.T @ change / len(change) + template.levers / width) @ root
    )
    count = int(np.clip(np.ceil(SEARCH_STDERRS * np.sqrt(squares[-1])), 1, MAX_STARTS))
    along = root @ directions[:, -1]
    small = [rigid(part * along) for part in np.linspace(-SEARCH_STDERRS, SEARCH_STDERRS, 2 * count + 1)]
    return [predicted.motion @ there @ one @ inverse(there) for one in small]


def registered(
    keyframes: Sequence[Keyframe], before: int, now: int, start: Floats
) -> tuple[float, Edge] | None:
    """The motion between two keyframes by their normals and heights, and how badly it fits, as chi squared.

    before, now : their indices. start : (4, 4), a first guess. None where they do not match.
    """
    template, there = keyframes[before].template, np.eye(4)
    there[:3, 3] = template.center
    found = align(template, keyframes[now].imprint, inverse(there) @ start @ there, None)
    if found is None or found.overlap < MIN_OVERLAP:
        return None
    if found.residual > MAX_RESIDUAL * template.signal:
        return None
    axes = turned(found.motion)
    by_slopes = axes @ (SLOPE_ERROR_PARTS * vector(found.motion))
    covariance = axes @ found.covariance @ axes.T
    return found.misfit, about_origin(before, now, found.motion, covariance, by_slopes, template.center)
