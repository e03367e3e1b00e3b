"""Normals and depth, on presses of real balls: one half of each set is learned, the other is judged."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lab.depth import SETS, chosen, radii_of, read, scale_of
from lab.peers.common import Numbers, Picture
from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.samples import reach
from tactflow.tools.bench.timing import TURN_FRAMES
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.types import Scale

Plane = NDArray[np.floating[Any]]
Answer = tuple[Plane, Plane]
"""Slopes (H, W, 2) of the depth to the right and down, mm per mm, and depth (H, W), mm."""
EPOCHS: Final = 60
"""Of the network: 120 instead of 40 gained 0.24 degrees on `mini_ball`."""
MAX_PIXELS: Final = 60_000
"""That the network learns from at most, so that a set takes seconds."""


# What a user of each package writes.


class Tactflow:
    """tactflow: a photometric calibration."""

    def __init__(self, session: Session, scale: Scale, radii: Sequence[float]) -> None:
        fitted = fit_photometry(session, scale, radii)
        self.surface, self.rest = Surface(fitted.model, scale), Rest(session.untouched)
        self.scale, self.centers = scale, fitted.centers

    def __call__(self, press: Press) -> Answer:
        """Depth, and its slopes."""
        heights = self.surface.depth(press.image, self.rest, press.mask).heights
        down, right = np.gradient(heights, self.scale.y, self.scale.x)
        return np.dstack([right, down]), heights


class PixelNetwork:
    """The method of gs_sdk: a network from colour and place of a pixel to its slopes, and a Poisson solver.

    Written here after its description (Huang et al., arXiv 2412.09617) and published settings: 5-128-32-32-2,
    batch normalisation, L1 loss of the slopes' angles, Adam, a rate that halves every tenth of the training.
    """

    def __init__(
        self,
        session: Session,
        scale: Scale,
        radii: Sequence[float],
        centers: Plane,
        subtract: bool,
        rate: float,
    ) -> None:
        self.scale, self.subtract = scale, subtract
        self.rest = session.untouched.astype(np.float32) / 255
        features, angles = zip(*self.samples(session, radii, centers), strict=True)
        self.network = train(np.concatenate(features), np.concatenate(angles), rate)
        self.flat = self.angles(session.untouched)

    def features(self, picture: Picture) -> NDArray[np.float32]:
        """(H, W, 5): blue, green, red, x, y of each pixel, 0 to 1."""
        height, width = picture.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        colour = picture.astype(np.float32) / 255 - (self.rest if self.subtract else 0)
        return np.dstack([colour, x / width, y / height])

    def samples(self, session: Session, radii: Sequence[float], centers: Plane) -> Iterator[Answer]:
        """Features and slopes' angles of pixels on the balls, and of the untouched gel."""
        for press, radius, center in zip(session.presses, radii, centers, strict=True):
            ball, dx, dy = on_ball(press, self.scale, radius, center)
            fall = np.sqrt(radius**2 - dx[ball] ** 2 - dy[ball] ** 2)
            angles = np.arctan(np.column_stack([-dx[ball], -dy[ball]]) / fall[:, None])
            yield self.features(press.image)[ball], angles
            flat = self.features(session.untouched).reshape(-1, 5)[
                :: max(1, 5 * ball.size // (ball.sum() + 1))
            ]
            yield flat, np.zeros((len(flat), 2))

    def angles(self, picture: Picture) -> Plane:
        """(H, W, 2): angles of the slopes."""
        import torch

        with torch.no_grad():
            found = self.network(torch.from_numpy(self.features(picture).reshape(-1, 5)))
        return found.numpy().reshape(*picture.shape[:2], 2)

    def __call__(self, press: Press) -> Answer:
        """Slopes, less those of the untouched gel, and their integral."""
        slopes = np.tan(self.angles(press.image)) - np.tan(self.flat)
        return slopes, integrate(slopes, self.scale)


def train(features: NDArray[np.float32], angles: Plane, rate: float) -> Any:
    """The trained network."""
    import torch
    from torch import nn

    torch.manual_seed(0)
    sizes = (5, 128, 32, 32)
    layers = [
        layer
        for inputs, outputs in pairwise(sizes)
        for layer in (nn.Linear(inputs, outputs), nn.BatchNorm1d(outputs), nn.ReLU())
    ]
    network = nn.Sequential(*layers, nn.Linear(sizes[-1], 2))
    inputs, targets = torch.from_numpy(features), torch.from_numpy(angles.astype(np.float32))
    some = torch.randperm(len(inputs))[:MAX_PIXELS]
    inputs, targets = inputs[some], targets[some]
    optimizer = torch.optim.Adam(network.parameters(), rate)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, EPOCHS // 10, 0.5)
    for _ in range(EPOCHS):
        for batch in torch.randperm(len(inputs)).split(1024):
            optimizer.zero_grad()
            nn.functional.l1_loss(network(inputs[batch]), targets[batch]).backward()
            optimizer.step()
        schedule.step()
    return network.eval()


def integrate(slopes: Plane, scale: Scale) -> Plane:
    """Depth (H, W), mm, with these slopes by least squares, and 0 in the median along the border."""
    from scipy.fft import dctn, idctn

    right, down = slopes[..., 0] * scale.x, slopes[..., 1] * scale.y
    source = np.zeros(right.shape)
    across, along = (right[:, :-1] + right[:, 1:]) / 2, (down[:-1] + down[1:]) / 2
    source[:, :-1] += across
    source[:, 1:] -= across
    source[:-1] += along
    source[1:] -= along
    height, width = source.shape
    weight = (
        4
        - 2 * np.cos(np.pi * np.arange(height) / height)[:, None]
        - 2 * np.cos(np.pi * np.arange(width) / width)
    )
    weight[0, 0] = 1
    depth = idctn(dctn(-source) / weight)
    return depth - np.median(np.concatenate([depth[0], depth[-1], depth[:, 0], depth[:, -1]]))


NETWORK: Final = "pixel network"
CHOICES: Final = (
    {"subtract": True, "rate": 0.02},
    {"subtract": False, "rate": 0.02},
)


# How they are measured.


def on_ball(
    press: Press, scale: Scale, radius: float, center: Plane
) -> tuple[NDArray[np.bool_], Plane, Plane]:
    """Pixels that show the ball for sure, and the distance of each pixel of the picture from `center`, mm."""
    y, x = np.mgrid[: press.mask.shape[0], : press.mask.shape[1]]
    dx, dy = (x - center[0]) * scale.x, (y - center[1]) * scale.y
    return (np.hypot(dx, dy) < reach(press, scale, radius)) & ~press.hidden, dx, dy


def errors_on(press: Press, answer: Answer, scale: Scale, radius: float) -> tuple[float, float]:
    """Mean angle of the normals, degrees, and relative error of how far the ball falls to the rim.

    As in `tactflow.calibration.samples`: the middle of the ball is the median of where the pixels say
    that it is, by the same answer.
    """
    slopes, depth = answer
    normals = -slopes / np.sqrt(1 + (slopes**2).sum(axis=2, keepdims=True))
    center = np.array(press.center)
    for _ in range(3):
        ball, dx, dy = on_ball(press, scale, radius, center)
        off = np.column_stack([dx[ball], dy[ball]]) - radius * normals[ball]
        center = center + np.median(off, axis=0) / (scale.x, scale.y)
    ball, dx, dy = on_ball(press, scale, radius, center)
    true = np.column_stack([dx[ball], dy[ball]]) / radius
    found = normals[ball]
    cosine = (true * found).sum(axis=1) + np.sqrt((1 - (true**2).sum(axis=1)) * (1 - (found**2).sum(axis=1)))
    cap = np.sqrt(radius**2 - dx[ball] ** 2 - dy[ball] ** 2)
    rise = cap - cap.mean()
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()), float(
        rise @ depth[ball] / (rise @ rise) - 1
    )


def judged(
    method: Callable[[Press], Answer], session: Session, scale: Scale, radii: Sequence[float]
) -> Numbers:
    """Median error of normals, degrees; RMS error of the cap, %."""
    errors = [errors_on(p, method(p), scale, r) for p, r in zip(session.presses, radii, strict=True)]
    angles, caps = np.transpose(errors)
    return {"normals": float(np.median(angles)), "cap": 100 * float(np.sqrt(np.mean(caps**2)))}


def on_balls(data: Path, with_network: bool, sets: Sequence[str] = tuple(SETS)) -> dict[str, Any]:
    """Each set: errors on the half that was not learned; ms a press; s to learn; settings of the network,
    chosen by what is learned from three quarters of its half and judged on the fourth."""
    answers: dict[str, Any] = {}
    for name in sets:
        session, names = read(SETS[name], data)
        scale, radii = scale_of(SETS[name], session), radii_of(SETS[name], names)
        (half, learned), (other, tested) = (chosen(session, radii, slice(start, None, 2)) for start in (0, 1))
        began = time.thread_time()
        ours = Tactflow(half, scale, learned)
        methods: dict[str, Any] = {"tactflow": ours}
        taken = {"tactflow": time.thread_time() - began}
        settings: dict[str, Any] = {"tactflow": {}}
        if with_network:
            settings[NETWORK] = min(
                CHOICES, key=lambda tried: _tried(half, scale, learned, ours.centers, tried)
            )
            began = time.thread_time()
            methods[NETWORK] = PixelNetwork(half, scale, learned, ours.centers, **settings[NETWORK])
            taken[NETWORK] = time.thread_time() - began
        times = _times(methods, other.presses)
        answers[name] = {
            method: {
                **judged(call, other, scale, tested),
                "ms": times[method],
                "learning_s": taken[method],
                "settings": settings[method],
            }
            for method, call in methods.items()
        } | {"presses": len(tested)}
    return answers


def _tried(
    session: Session, scale: Scale, radii: Sequence[float], centers: Plane, settings: Mapping[str, Any]
) -> float:
    """Error of normals on every fourth press, learned from the others."""
    fourth = np.arange(len(radii)) % 4 == 3
    parts = []
    for which in (~fourth, fourth):
        index = np.flatnonzero(which)
        part = Session(
            session.untouched,
            session.mapping,
            [session.presses[i] for i in index],
            session.dots,
            session.frames,
        )
        parts.append((part, [radii[i] for i in index], centers[index]))
    (learned, own, places), (held, theirs, _) = parts
    return judged(PixelNetwork(learned, scale, own, places, **settings), held, scale, theirs)["normals"]


def _times(methods: Mapping[str, Any], presses: Sequence[Press]) -> Numbers:
    """Median CPU time of a press, ms; methods take turns."""
    times: dict[str, list[float]] = {name: [] for name in methods}
    for first in range(0, len(presses), TURN_FRAMES):
        for name, method in methods.items():
            for press in presses[first : first + TURN_FRAMES]:
                began = time.thread_time()
                method(press)
                times[name].append(time.thread_time() - began)
    return {name: 1e3 * float(np.median(values)) for name, values in times.items()}
