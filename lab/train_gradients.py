"""Train a network for single pixels that tells the slope of the gel from its colour, as gs_sdk does it.

    python lab/train_gradients.py presses --out gradients.onnx

`presses` is a folder with `background.png`, pictures of presses of one ball, and `labels.csv`: image, x_px,
y_px, radius_px, split ("train" for those to use). `--radius` is that of the ball, mm, `--scale` that of the
pictures, mm per px. Inside a contact the surface is the ball; elsewhere the slope is 0. Needs the extra
`train`. `python -m lab.peers` compares such a network with `tactflow calibrate`.

Method: J. Zhao and M. Bauza, "FingerSLAM"; H. Huang, M. Kaess, W. Yuan, "NormalFlow", RA-L 2024 (gs_sdk).
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.calibration.presses import Press

HIDDEN_NEURONS = 64
"""Neurons of each of three hidden layers."""
REST_SHARE = 0.05
"""Pixels at rest that are learned, as a part of all."""

Image = NDArray[np.uint8]


def main() -> None:
    """Train and write the network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("presses", type=Path)
    parser.add_argument("--out", type=Path, default=Path("gradients.onnx"))
    parser.add_argument("--radius", type=float, default=9.47 / 2)
    parser.add_argument("--scale", type=float, default=0.0634)
    parser.add_argument("--epochs", type=int, default=10)
    args = parser.parse_args()
    rest = cv2.imread(str(args.presses / "background.png"))
    if rest is None:
        sys.exit(f"{args.presses}: required background.png and labels.csv")
    train(read(args.presses), rest, args.radius / args.scale, args.epochs, args.out)


def read(folder: Path) -> list[Press]:
    """The presses to use, with their measured circles."""
    presses = []
    with (folder / "labels.csv").open() as lines:
        for number, row in enumerate(csv.DictReader(lines)):
            if row["split"] != "train":
                continue
            image = cv2.imread(str(folder / row["image"]))
            assert image is not None, row["image"]
            x, y, radius = (float(row[key]) for key in ("x_px", "y_px", "radius_px"))
            rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
            mask = np.where(np.hypot(columns - x, rows - y) < radius, 255, 0).astype(np.uint8)
            presses.append(Press(number, image, mask, np.zeros(mask.shape, np.bool_), (x, y), radius))
    return presses


def slopes_of_ball(press: Press, ball: float) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Where the surface is the ball, (H, W) bool, and its slopes to the right and down there, (n, 2).

    The gel is pushed in deeper towards the middle of the ball. ball : its radius, px.
    """
    rows, columns = np.mgrid[: press.mask.shape[0], : press.mask.shape[1]]
    dx, dy = columns - press.center[0], rows - press.center[1]
    distance = np.hypot(dx, dy)
    inside = distance < min(press.radius, ball)
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
        inside, slopes = slopes_of_ball(press, ball)
        calm = (cv2.dilate(press.mask, np.ones((31, 31))) == 0) & (rng.random(inside.shape) < REST_SHARE)
        samples += [table[inside], table[calm]]
        aims += [slopes, np.zeros((np.count_nonzero(calm), 2), np.float32)]
    x, y = torch.from_numpy(np.concatenate(samples)), torch.from_numpy(np.concatenate(aims))
    layers: list[nn.Module] = [nn.Linear(5, HIDDEN_NEURONS)]
    for _ in range(2):
        layers += [nn.ReLU(), nn.Linear(HIDDEN_NEURONS, HIDDEN_NEURONS)]
    network = nn.Sequential(*layers, nn.ReLU(), nn.Linear(HIDDEN_NEURONS, 2))
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


if __name__ == "__main__":
    main()
