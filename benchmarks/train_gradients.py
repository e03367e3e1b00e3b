"""Train a network for single pixels that tells the slope of the gel from its colour, as gs_sdk does it.

    python benchmarks/train_gradients.py presses --out gradients.onnx
    python benchmarks/train_gradients.py presses --compare gradients.onnx

`presses` is a folder with `background.png`, pictures of presses of one ball, and `labels.csv`: image, x_px,
y_px, radius_px, split. `--radius` and `--scale` are of the ball, mm, and of the pictures, mm per px. Inside a
contact the surface is the ball; at the rest of the gel the slope is 0. Presses of the split "train" are
learned; `--compare` prints the errors on the others, beside those of `tactflow calibrate` from the same
presses. Needs the extra `train`, and `onnx` to compare.

Method: J. Zhao and M. Bauza, "FingerSLAM"; H. Huang, M. Kaess, W. Yuan, "NormalFlow", RA-L 2024 (gs_sdk).
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.photometric import fit_photometry
from tactflow.calibration.presses import Press, Session
from tactflow.calibration.samples import reach
from tactflow.calibration.scale import centre
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.geometry import Preprocessor
from tactflow.vision.types import Scale

HIDDEN = 64
"""Neurons of each of three hidden layers."""
AT_REST = 0.05
"""Pixels at rest that are learned, as a part of all."""

Image = NDArray[np.uint8]


def main() -> None:
    """Train, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("presses", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--compare", type=Path, metavar="ONNX")
    parser.add_argument("--radius", type=float, default=9.47 / 2)
    parser.add_argument("--scale", type=float, default=0.0634)
    parser.add_argument("--epochs", type=int, default=10)
    args = parser.parse_args()
    rest = cv2.imread(str(args.presses / "background.png"))
    if rest is None:
        sys.exit(f"{args.presses}: required background.png and labels.csv")
    ball = args.radius / args.scale
    if args.out:
        train(read(args.presses, "train"), rest, ball, args.epochs, args.out)
    if args.compare:
        compare(args, rest, ball)


def read(folder: Path, split: str) -> list[Press]:
    """The presses of one split, with their measured circles."""
    found = []
    with (folder / "labels.csv").open() as lines:
        for number, row in enumerate(csv.DictReader(lines)):
            if row["split"] != split:
                continue
            image = cv2.imread(str(folder / row["image"]))
            assert image is not None, row["image"]
            x, y, radius = (float(row[key]) for key in ("x_px", "y_px", "radius_px"))
            rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
            mask = np.where(np.hypot(columns - x, rows - y) < radius, 255, 0).astype(np.uint8)
            found.append(Press(number, image, mask, np.zeros(mask.shape, np.bool_), (x, y), radius))
    return found


def slopes_of_ball(press: Press, ball: float, within: float) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Where the surface is the ball, (H, W) bool, and its slopes to the right and down there, (n, 2).

    The gel is pushed in deeper towards the middle of the ball. ball : its radius, px. within : distance from
    its middle, px.
    """
    rows, columns = np.mgrid[: press.mask.shape[0], : press.mask.shape[1]]
    dx, dy = columns - press.center[0], rows - press.center[1]
    distance = np.hypot(dx, dy)
    inside = distance < min(within, ball)
    height = np.sqrt(ball**2 - distance[inside] ** 2)
    return inside, np.stack([-dx[inside] / height, -dy[inside] / height], axis=1).astype(np.float32)


def train(presses: list[Press], rest: Image, ball: float, epochs: int, out: Path) -> None:
    """Learn, and write the network with the normalisation of `examples/networks/gradients.yaml`."""
    import torch
    from torch import nn

    torch.manual_seed(0)
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    height, width = rest.shape[:2]
    rows, columns = np.mgrid[:height, :width]
    samples, aims = [], []
    for press in presses:
        change = (press.image.astype(np.float32) - rest) / 255
        table = np.dstack([change, columns / width, rows / height]).astype(np.float32)
        inside, slopes = slopes_of_ball(press, ball, press.radius)
        calm = (cv2.dilate(press.mask, np.ones((31, 31))) == 0) & (rng.random(inside.shape) < AT_REST)
        samples += [table[inside], table[calm]]
        aims += [slopes, np.zeros((np.count_nonzero(calm), 2), np.float32)]
    x, y = torch.from_numpy(np.concatenate(samples)), torch.from_numpy(np.concatenate(aims))
    layers: list[nn.Module] = [nn.Linear(5, HIDDEN)]
    for _ in range(2):
        layers += [nn.ReLU(), nn.Linear(HIDDEN, HIDDEN)]
    network = nn.Sequential(*layers, nn.ReLU(), nn.Linear(HIDDEN, 2))
    optimiser = torch.optim.Adam(network.parameters(), 2e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, epochs)
    for epoch in range(epochs):
        total = 0.0
        for batch in torch.randperm(len(x)).split(2048):
            optimiser.zero_grad()
            loss = nn.functional.mse_loss(network(x[batch]), y[batch])
            loss.backward()
            optimiser.step()
            total += float(loss.detach()) * len(batch)
        schedule.step()
        print(f"epoch {epoch + 1}: {total / len(x):.5f}", flush=True)
    write(network, out)


def write(network: Any, out: Path) -> None:
    """Write the layers as an ONNX file with the input `pixels` (N, 5) and the output `gradients` (N, 2)."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, weights, value = [], [], "pixels"
    linear = [layer for layer in network if hasattr(layer, "weight")]
    for number, layer in enumerate(linear):
        result = "gradients" if number == len(linear) - 1 else f"sum{number}"
        for name, tensor in (("w", layer.weight), ("b", layer.bias)):
            weights.append(numpy_helper.from_array(tensor.detach().numpy(), f"{name}{number}"))
        nodes.append(helper.make_node("Gemm", [value, f"w{number}", f"b{number}"], [result], transB=1))
        value = result
        if number < len(linear) - 1:
            value = f"hidden{number}"
            nodes.append(helper.make_node("Relu", [result], [value]))
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["pixels", count])]
        for name, count in (("pixels", 5), ("gradients", 2))
    ]
    graph = helper.make_graph(nodes, "gradients", *ends, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    out.write_bytes(onnx.ModelProto.SerializeToString(model))
    print(f"wrote {out}")


def compare(args: argparse.Namespace, rest: Image, ball: float) -> None:
    """Print normals, radius of the sphere and time on the test presses: the network, and `calibrate`."""
    import tactflow

    height, width = rest.shape[:2]
    scale = Scale(args.scale, args.scale, (0.0, 0.0), centre((width, height)))
    learned, others = read(args.presses, "train"), read(args.presses, "test")
    mapping = Preprocessor((width, height)).mapping
    session = Session(rest, mapping, learned, np.zeros((0, 2)), len(learned))
    model = fit_photometry(session, scale, args.radius).model
    surface, at_rest = Surface(model, scale), Rest(rest)
    pixels = {"background": "subtract", "coordinates": True, "layout": "pixels"}
    stage: Any = tactflow.stage(
        "network", file=str(args.compare), inputs={"pixels": pixels}, outputs={"gradients": {}}
    )

    def network(press: Press) -> NDArray[np.float32]:
        (gradients,) = stage.process(press.image, rest)
        return surface.depth(press.image, at_rest, press.mask, gradients).heights

    def ours(press: Press) -> NDArray[np.float32]:
        return surface.depth(press.image, at_rest, press.mask).heights

    print("| method | normals, deg, mean (median, 95 %) | radius of the sphere, error, % | ms a frame |")
    print("| --- | --- | --- | --- |")
    for name, method in (("network for pixels", network), ("calibrate", ours)):
        angles, radii, times = [], [], []
        for press in [others[0], *others]:
            began = time.thread_time()
            heights = method(press)
            times.append(1e3 * (time.thread_time() - began))
            inside, true = slopes_of_ball(press, ball, reach(press, scale, args.radius) / args.scale)
            down, right = np.gradient(heights, args.scale)
            angles.append(angle(np.stack([right[inside], down[inside]], axis=1), true))
            radii.append(sphere(heights, inside, args.scale))
        found, errors = np.concatenate(angles[1:]), 100 * np.abs(np.array(radii[1:]) / args.radius - 1)
        q50, q95 = np.percentile(found, (50, 95))
        print(
            f"| {name} | {found.mean():.2f} ({q50:.2f}, {q95:.2f}) | {np.median(errors):.1f} median, "
            f"{errors.max():.1f} worst | {np.median(times[1:]):.2f} |"
        )
    print(f"{len(learned)} presses learned, {len(others)} compared; true radius {args.radius:g} mm")


def angle(slopes: NDArray[np.float32], true: NDArray[np.float32]) -> NDArray[np.float64]:
    """(n,): angle between the normals of two sets of slopes (n, 2), degrees."""
    first, second = (np.column_stack([-s, np.ones(len(s))]) for s in (slopes, true))
    cosine = np.sum(first * second, axis=1) / np.linalg.norm(first, axis=1) / np.linalg.norm(second, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def sphere(heights: NDArray[np.float32], inside: NDArray[Any], scale: float) -> float:
    """Radius of the sphere that fits the heights best, mm: linear least squares."""
    rows, columns = np.nonzero(inside)
    x, y, z = columns * scale, rows * scale, heights[inside].astype(float)
    terms = np.column_stack([x, y, z, np.ones(len(x))])
    a, b, c, d = np.linalg.lstsq(terms, x**2 + y**2 + z**2, rcond=None)[0]
    return float(np.sqrt(max(d + (a**2 + b**2 + c**2) / 4, 0.0)))


if __name__ == "__main__":
    main()
