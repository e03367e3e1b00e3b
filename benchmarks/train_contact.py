"""Train the contact network on the random scenes of `benchmarks/wide.py`, and on nothing else.

    pip install "tactflow[train]"
    python -m benchmarks.train_contact

The result replaces src/tactflow/vision/contact/contact.onnx. Scenes, weights and order follow from fixed
seeds. `--scenes` and `--steps` are for shorter trials.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

import tactflow.vision.contact as room
from benchmarks.wide import WideScene, wide_scene
from tactflow.vision.contact.change import CELLS, PLANES, Untouched, to_cells
from tactflow.vision.contact.network import WEIGHTS
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.types import Markers

WIDTHS: Final = (12, 24, 32, 40)
"""Channels at a half, a quarter, an eighth and a sixteenth of the grid: 72,000 weights, 290 kB."""
BATCH: Final = 24
RATE: Final = 3e-3
"""Largest learning rate; it falls as a cosine."""
OVERLAP: Final = 0.1
"""Weight of the overlap (Dice) beside the cross entropy, which alone would leave small contacts to last."""
FIRST_JUDGED: Final = 1_000_000
"""Seed of the first of 400 scenes that are not trained on."""

Half = NDArray[np.float16]
Bytes = NDArray[np.uint8]


def sample(seed: int) -> tuple[Half, Bytes]:
    """A scene as the network sees it, and the truth.

    Returns (12, 128, 128) float16, zero outside of the picture, and (128, 128) uint8: the part of each cell
    in contact, 0 to 200; 255 outside of the picture.
    """
    cv2.setNumThreads(1)
    scene = wide_scene(seed)
    reference = remove_markers(scene.reference, scene.reference_dots)
    markers = _tracked(scene, np.random.default_rng([1, seed])) if scene.dots.any() else None
    change = Untouched(reference).change(remove_markers(scene.picture, scene.dots), scene.dots, markers)
    planes, truth = np.zeros((PLANES, CELLS, CELLS), np.float16), np.full((CELLS, CELLS), 255, np.uint8)
    planes[:, : change.planes.shape[1], : change.planes.shape[2]] = change.planes
    contact = to_cells(scene.contact.astype(np.uint8) * np.uint8(200), change.size)
    truth[: change.size[0], : change.size[1]] = np.rint(contact)
    return planes, truth


def _tracked(scene: WideScene, random: Generator) -> Markers:
    """The dots as a tracker would find them: not all, and with errors."""
    seen = random.random(len(scene.origin)) > random.choice([0, 0.05, 0.2])
    origin, position = scene.origin[seen].astype(np.float64), scene.position[seen].astype(np.float64)
    position += random.normal(0, random.choice([0.03, 0.1, 0.3]), position.shape)
    mistaken = random.random(len(position)) < random.choice([0, 0, 0.02])
    position[mistaken] += random.normal(0, 4, (np.count_nonzero(mistaken), 2))
    return Markers(origin, position, np.zeros(len(origin), np.uint8), np.full(len(origin), 0.1))


def draw(first: int, number: int) -> tuple[Half, Bytes]:
    """Samples of so many seeds from the first on, by two processes: (N, 12, 128, 128), (N, 128, 128)."""
    planes = np.empty((number, PLANES, CELLS, CELLS), np.float16)
    truths = np.empty((number, CELLS, CELLS), np.uint8)
    with ProcessPoolExecutor(2) as pool:
        pairs = pool.map(sample, range(first, first + number), chunksize=20)
        for index, (plane, truth) in enumerate(pairs):
            planes[index], truths[index] = plane, truth
    return planes, truths


def _layers(inputs: int, outputs: int, size: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, (size - 1) // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class Network(nn.Module):
    """A U-Net whose skip connections add: (N, 12, h, w) -> (N, 1, h, w) log odds, sides multiples of 16."""

    def __init__(self) -> None:
        super().__init__()
        channels = (PLANES, *WIDTHS)
        self.down = nn.ModuleList(
            nn.Sequential(_layers(above, below, 4 if level == 0 else 3, 2), _layers(below, below))
            for level, (above, below) in enumerate(itertools.pairwise(channels))
        )
        pairs = list(itertools.pairwise(WIDTHS))[::-1]
        self.narrow = nn.ModuleList(nn.Conv2d(below, above, 1) for above, below in pairs)
        self.up = nn.ModuleList(_layers(above, above) for above, _ in pairs)
        self.out = nn.Conv2d(WIDTHS[0], 4, 1)

    def forward(self, planes: Tensor) -> Tensor:
        levels = []
        for layers in self.down:
            planes = layers(planes)
            levels.append(planes)
        planes = levels.pop()
        for narrow, layers in zip(self.narrow, self.up, strict=True):
            larger = functional.interpolate(narrow(planes), scale_factor=2, mode="bilinear")
            planes = layers(larger + levels.pop())
        return functional.pixel_shuffle(self.out(planes), 2)


def augmented(planes: Half, truth: Bytes, random: Generator) -> tuple[NDArray[np.float32], Bytes]:
    """The sample turned, mirrored, in other colours, with the light inverted, without dots: as likely."""
    x = planes.astype(np.float32)
    colours = random.permutation(3)
    x[:6] = x[:6][np.concatenate([colours, 3 + colours])]
    if random.random() < 0.5:
        x[:6] *= -1
    if random.random() < 0.25:
        x[8:] = 0
    if random.random() < 0.15:
        x[6] = 0
    if random.random() < 0.5:
        x, truth = x[:, ::-1].copy(), truth[::-1]
        x[9] *= -1
    if random.random() < 0.5:
        x, truth = x[:, :, ::-1].copy(), truth[:, ::-1]
        x[8] *= -1
    if random.random() < 0.5:
        x, truth = x.transpose(0, 2, 1).copy(), truth.T
        x[8:10] = x[9:7:-1].copy()
    return x, np.ascontiguousarray(truth)


def losses(odds: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """What is minimised, and the cross entropy alone, nats a cell."""
    inside, target = (truth < 255).float(), truth.clamp(max=200).float() / 200
    entropy = functional.binary_cross_entropy_with_logits(odds, target, reduction="none")
    entropy = (entropy * inside).sum() / inside.sum()
    likely, target = torch.sigmoid(odds) * inside, target * inside
    common = (2 * (likely * target).sum((1, 2)) + 20) / (likely.sum((1, 2)) + target.sum((1, 2)) + 20)
    return entropy + OVERLAP * (1 - common.mean()), entropy


def judged(network: nn.Module, planes: Half, truths: Bytes) -> str:
    """Errors on scenes that were not trained on."""
    network.eval()
    overlaps, false, entropies = [], [], []
    with torch.no_grad():
        for start in range(0, len(planes), 50):
            odds = network(torch.from_numpy(planes[start : start + 50].astype(np.float32)))[:, 0]
            truth = torch.from_numpy(truths[start : start + 50])
            entropies.append(losses(odds, truth)[1].item())
            found, true = (odds > 0) & (truth < 255), (truth >= 100) & (truth < 255)
            common, either = (found & true).sum((1, 2)), (found | true).sum((1, 2))
            touched = true.any(2).any(1)
            overlaps += (common / either.clamp(min=1))[touched].tolist()
            most = odds.where(truth < 255, -10).amax((1, 2))
            false += (most > math.log(9))[~touched].tolist()
    network.train()
    overlap = f"overlap {np.median(overlaps):.3f}, false {np.mean(false):.1%}"
    return f"cross entropy {np.mean(entropies):.4f}, {overlap}"


def train(planes: Half, truths: Bytes, unseen: tuple[Half, Bytes], steps: int) -> dict[str, Any]:
    """The weights, averaged over the last steps."""
    torch.manual_seed(0)
    random = np.random.default_rng(0)
    network = Network().to(memory_format=torch.channels_last)
    mean = {name: value.clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-3)
    order: list[int] = []
    for step in range(steps):
        rate = RATE * min(1, (step + 1) / 100) * 0.5 * (1 + np.cos(np.pi * step / steps)) + 1e-5
        for group in optimiser.param_groups:
            group["lr"] = rate
        if len(order) < BATCH:
            order = random.permutation(len(planes)).tolist()
        batch = [augmented(planes[i], truths[i], random) for i in (order.pop() for _ in range(BATCH))]
        inputs = torch.from_numpy(np.stack([x for x, _ in batch])).to(memory_format=torch.channels_last)
        with torch.autocast("cpu", torch.bfloat16):
            odds = network(inputs)
        loss, _ = losses(odds.float()[:, 0], torch.from_numpy(np.stack([truth for _, truth in batch])))
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        if step % 10 == 9:
            keep = min(0.99, step / (step + 200))
            for name, value in network.state_dict().items():
                if value.dtype.is_floating_point:
                    mean[name].mul_(keep).add_(value, alpha=1 - keep)
        if step % 500 == 499:
            print(f"{step + 1} of {steps}: {judged(network, *unseen)}", flush=True)
    return mean


def export(weights: dict[str, Any], path: Path) -> None:
    """Write the network as ONNX. OpenCV takes input of other sides, too; version 4 reads no free sides."""
    network = Network()
    network.load_state_dict(weights)
    network.eval()
    torch.onnx.export(
        network,
        (torch.zeros(1, PLANES, CELLS, CELLS),),
        str(path),
        opset_version=13,
        dynamo=False,
        input_names=["planes"],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20_000)
    parser.add_argument("--steps", type=int, default=12_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path(room.__file__).with_name(WEIGHTS))
    options = parser.parse_args()
    started = time.monotonic()
    planes, truths = draw(0, options.scenes)
    unseen = draw(FIRST_JUDGED, 400)
    print(f"{options.scenes} scenes after {(time.monotonic() - started) / 60:.0f} min", flush=True)
    torch.set_num_threads(options.threads)
    weights = train(planes, truths, unseen, options.steps)
    export(weights, options.out)
    network = Network()
    network.load_state_dict(weights)
    print(f"{judged(network, *unseen)}; {options.out} after {(time.monotonic() - started) / 60:.0f} min")


if __name__ == "__main__":
    main()
