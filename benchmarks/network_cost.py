"""Measure the stage `network` without its inference, per preparation, in copies of a raw frame.

    python benchmarks/network_cost.py                          # this checkout
    python benchmarks/network_cost.py --against OLD_network.py # its module in an older state, in turns

Inputs are those of `examples/networks`, then single steps of the preparation. The network itself is replaced
by one that returns the same arrays at once. CPU time, medians.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any

import numpy as np
import yaml

from tactflow.adapters import network
from tactflow.bench.timing import BLOCK, CopyUnit, quiet

EXAMPLES = Path(__file__).resolve().parents[1] / "examples" / "networks"
RESIZED: dict[str, Any] = {"size": [224, 224], "colour": "rgb"}
TURNS = 30
"""Blocks of frames for each alternative."""
Case = tuple[dict[str, Any], tuple[int, int], str, tuple[int, ...]]
"""Settings of the input, its height and width, the port of the output and its shape."""


def cases() -> dict[str, Case]:
    """Name -> what is measured."""
    encoder, gradients = (
        next(iter(yaml.safe_load((EXAMPLES / name).read_text())["stages"]["network"]["inputs"].values()))
        for name in ("encoder.yaml", "gradients.yaml")
    )
    features, full, square = ("features", (1, 512)), (400, 300), (224, 224)
    return {
        "encoder.yaml, 300 x 400": (encoder, full, *features),
        "gradients.yaml, 320 x 240": (gradients, (240, 320), "gradients", (240 * 320, 2)),
        "300 x 400, resized to 224 x 224": (RESIZED, full, *features),
        "224 x 224": ({"colour": "rgb"}, square, *features),
        "224 x 224, mean and std": ({"mean": [0.5, 0.4, 0.3], "std": [0.2] * 3}, square, *features),
        "224 x 224, change of light": ({"background": "subtract"}, square, *features),
        "224 x 224, grey": ({"colour": "grey"}, square, *features),
        "224 x 224, channels last": ({"layout": "hwc"}, square, *features),
        "224 x 224, with the untouched gel": ({"background": "concat"}, square, *features),
        "224 x 224, contact mask": ({}, square, "contact_mask", (1, 224, 224)),
    }


def make_stage(module: Any, case: Case) -> Any:
    """The stage of a module, ready for frames."""
    settings, size, port, shape = case
    params = module.Network.Params(file="none", inputs={"x": settings}, outputs={port: {}})
    stage = module.Network(params)
    given = stage._feeds["x"].params
    height, width = (given.size or size[::-1])[::-1]
    sides = given.shape(given.channels, height, width)
    stage._feeds["x"].fit("x", sides if given.layout == "pixels" else (1, *sides), "tensor(float)")
    answer = [np.zeros(shape, np.float32)]
    stage._session, stage._wanted = SimpleNamespace(run=lambda *_: answer), [port]
    return stage


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--against", type=Path, metavar="FILE", help="network.py of an older state")
    path = parser.parse_args().against
    modules = {"new": network}
    if path is not None:
        spec = importlib.util.spec_from_file_location("older_network", path)
        assert spec is not None
        assert spec.loader is not None
        modules = {"old": importlib.util.module_from_spec(spec), **modules}
        sys.modules["older_network"] = modules["old"]
        spec.loader.exec_module(modules["old"])
    found: dict[tuple[str, str], list[float]] = {}
    unit, rng = CopyUnit(), np.random.default_rng(0)
    with quiet():
        for title, case in cases().items():
            frames = [rng.integers(0, 256, (*case[1], 3), np.uint8) for _ in range(BLOCK)]
            stages = {name: make_stage(module, case) for name, module in modules.items()}
            for _ in range(TURNS):
                unit.take()
                for name, stage in stages.items():
                    inputs = [frames[0]] * (len(stage._names) - 1)
                    for frame in frames:
                        began = time.thread_time()
                        stage.process(frame, *inputs)
                        found.setdefault((title, name), []).append(1e3 * (time.thread_time() - began))
    print(f"one copy: {unit.copy_ms:.3f} ms\n{'preparation':<36}" + "".join(f"{n:>18}" for n in modules))
    for title in cases():
        times = [median(found[title, name]) for name in modules]
        print(f"{title:<36}" + "".join(f"{t:>8.3f} ms {t / unit.copy_ms:>6.2f}" for t in times))


if __name__ == "__main__":
    main()
