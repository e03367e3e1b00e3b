"""Measure the CPU time of a frame in the default pipeline, in total and per stage, and the startup time.

    python lab/frame_cost.py                        # this checkout
    python lab/frame_cost.py --against DIR          # DIR (old) and this checkout (new) in turns
    python lab/frame_cost.py --scene "press?light=bright" --pipeline classic    # for the README
    python lab/frame_cost.py --against DIR --grasps ../shared/data              # whole real grasps

Each checkout needs its own `.venv`. The pipeline runs in one thread with a JSON Lines sink; reading the
recording is not counted. Behind each median is the ratio of the 99th percentile to it. Two checkouts take
turns every 20 frames, and each frame is compared with the same frame of the other. So the median ratio new
/ old and its 95 % interval (bootstrap over runs) are robust to other load on the machine, unlike the times
themselves.

Of real grasps, from before the first touch until after the last, the table has the mean of a frame, and the
ratio of the sums; a stage that a frame does not need costs nothing in it.
"""

from __future__ import annotations

import argparse
import gc
import json
import random
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from inspect import signature
from itertools import islice
from pathlib import Path
from statistics import fmean, median, quantiles
from types import MappingProxyType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SCENES = ("press", "cable", "dense")
SCENE_FRAMES = 240
"""Frames of each scene: several presses, about half of the frames with contact."""
GRASPS = (
    ("franka_mini", "mini", "gels/franka_mini/*.avi", 11, {}),
    ("wedge_grip", "markerless", "wedge_grip/*.avi", 2, {"stages.preprocess.rotate": 0}),
)
"""Name, shipped pipeline, recordings in the folder of recordings, every how many of them, and settings."""
TURN_FRAMES = 20
"""Frames per turn, read before the clock starts: they are in memory, but not in the CPU's cache."""
START_COMMANDS = {
    "import tactflow": "-c 'import tactflow'",
    "tactflow run, 2 frames": "-m tactflow run --max-frames 2 --quiet --set sinks.jsonl.path=/dev/null",
}
"""Commands whose wall time is measured, as arguments of Python."""

Times = dict[str, float]
"""Name of a measurement -> ms."""
Samples = dict[str, list[Times]]
"""Checkout (`old`, `new`) -> its measurements, in the same order for both."""


class Stopwatch:
    """Collects the CPU time of each frame and of the stages within it by patching their classes.

    frames : seq -> times; `frame` is the total, including the engine.
    """

    def __init__(self) -> None:
        self.frames: dict[int, Times] = {}
        self._stages: Times = {}

    def time_source(self, _: str, cls: type, method: str) -> None:
        """Measure the time until the pipeline requests the next frame of this source."""
        original = getattr(cls, method)

        def frames(source: Any) -> Iterator[Any]:
            pending = original(source)
            # Copy, to avoid page faults of a mapped file while the clock runs.
            while block := [
                replace(frame, image=frame.image.copy()) for frame in islice(pending, TURN_FRAMES)
            ]:
                print("ready", flush=True)
                sys.stdin.readline()
                for frame in block:
                    self._stages = {}
                    began = time.thread_time()
                    yield frame
                    total = 1e3 * (time.thread_time() - began)
                    if not frame.reference:
                        self.frames[frame.seq] = {"frame": total, **self._stages}

        setattr(cls, method, frames)

    def time_calls(self, name: str, cls: type, method: str) -> None:
        """Measure the calls of a stage's `process` or a sink's `write`."""
        original = getattr(cls, method)

        def call(*args: Any, **options: Any) -> Any:
            began = time.thread_time()
            result = original(*args, **options)
            self._stages[name] = 1e3 * (time.thread_time() - began)
            return result

        call.__signature__ = signature(original)  # type: ignore[attr-defined]
        setattr(cls, method, call)


def measure_frames(file: str, settings: Mapping[str, Any], recording: Path, results: Path) -> list[Times]:
    """CPU times of each frame in the current checkout, ms, as `contact frame`, `idle tracker`, ..."""
    import tactflow

    settings = {**settings, "sinks": {"jsonl": {"path": str(results), "segment": "capture"}}}
    for node in tactflow.load(file).nodes.values():
        if node.component.kind == "stage":
            settings[f"stages.{node.id}.segment"] = "capture"
    pipeline = tactflow.load(file, source=str(recording), settings=settings)
    stopwatch = Stopwatch()
    for node in pipeline.nodes.values():
        method = {"source": "frames", "stage": "process", "sink": "write"}[node.component.kind]
        time_method = stopwatch.time_source if method == "frames" else stopwatch.time_calls
        time_method(node.id, node.component.cls, method)
    gc.disable()
    tactflow.run(pipeline)
    messages = map(json.loads, results.read_text().splitlines())
    kinds = {m["seq"]: "idle" if m["contact"] is None else "contact" for m in messages}
    names = ("frame", *pipeline.nodes)
    frames = stopwatch.frames.items()
    return [{f"{kinds[seq]} {n}": times[n] for n in names if n in times} for seq, times in frames]


def python(tree: Path, *arguments: str | Path) -> list[str]:
    """Command line for the Python of a checkout."""
    return [str(tree / ".venv" / "bin" / "python"), *map(str, arguments)]


def measure_recording(
    trees: dict[str, Path], file: str, recording: Path, settings: Mapping[str, Any] = MappingProxyType({})
) -> Samples:
    """Run all checkouts on a recording, taking turns of `TURN_FRAMES` frames."""
    children: dict[str, Any] = {}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with tempfile.TemporaryDirectory() as folder:
        for name, tree in trees.items():
            given = json.dumps(dict(settings))
            child = ("--pipeline", file, "--child", given, recording.resolve(), f"{folder}/{name}.jsonl")
            command = python(tree, Path(__file__).resolve(), *child)
            children[name] = subprocess.Popen(command, cwd=tree, **pipes)
            children[name].stdout.readline()
        samples: Samples = {}
        while len(samples) < len(children):
            for name in children.keys() - samples.keys():
                print(file=children[name].stdin, flush=True)
                answer = children[name].stdout.readline()
                if answer != "ready\n":
                    samples[name] = json.loads(answer)
    # In the order of the header.
    return {name: samples[name] for name in trees}


def finish(tree: Path, *words: str) -> None:
    """Run Python in a checkout; ends this program if it fails, with its last words."""
    ended = subprocess.run(python(tree, *words), cwd=tree, capture_output=True, text=True, check=False)
    if ended.returncode:
        sys.exit(f"{tree}: python {shlex.join(words)}: {ended.stderr.strip()}")


def measure_start(trees: dict[str, Path]) -> Samples:
    """Wall time of the commands of `START_COMMANDS`, ms."""
    samples: Samples = {name: [{}] for name in trees}
    for name, tree in trees.items():
        for title, arguments in START_COMMANDS.items():
            began = time.perf_counter()
            finish(tree, *shlex.split(arguments))
            samples[name][0][title] = 1e3 * (time.perf_counter() - began)
    return samples


def print_rows(title: str, turns: Sequence[Samples]) -> None:
    """Print the median of each measurement and, for two checkouts, the median ratio."""
    for key in dict.fromkeys(key for turn in turns for times in turn["new"] for key in times):
        row, ratios = f"{title + key:<32}", []
        for name in turns[0]:
            values = [times[key] for turn in turns for times in turn[name] if key in times]
            row += f"{median(values):10.3f}" if values else f"{'-':>10}"
            row += f"{quantiles(values, n=100)[-1] / median(values):7.1f}" if len(values) > 100 else " " * 7
        for turn in turns if "old" in turns[0] else []:
            frames = zip(turn["old"], turn["new"], strict=True)
            pairs = [new[key] / old[key] for old, new in frames if key in old and key in new]
            ratios += [median(pairs)] if pairs else []
        print(row + ratio_text(ratios), flush=True)


def print_means(name: str, turns: Sequence[Samples]) -> None:
    """Print the mean of the whole frame and of each stage over all frames, and the ratio of the sums."""
    frames = {tree: [merged(times) for turn in turns for times in turn[tree]] for tree in turns[0]}
    for key in dict.fromkeys(key for times in frames["new"] for key in times):
        row = f"{name + ', ' + key:<32}"
        for times in frames.values():
            row += f"{fmean(frame.get(key, 0.0) for frame in times):10.3f}{'':7}"
        sums = [
            {tree: sum(merged(frame).get(key, 0.0) for frame in turn[tree]) for tree in turn}
            for turn in (turns if "old" in frames else ())
        ]
        print(row + ratio_text([turn["new"] / turn["old"] for turn in sums if turn["old"]]), flush=True)


def merged(times: Times) -> Times:
    """The times of a frame without the kind of frame in their names."""
    return {key.partition(" ")[2]: value for key, value in times.items()}


def ratio_text(ratios: Sequence[float]) -> str:
    """The median of the ratios, and its 95 % interval by bootstrap."""
    if not ratios:
        return ""
    rng = random.Random(0)
    low, *_, high = quantiles((median(rng.choices(ratios, k=len(ratios))) for _ in range(2000)), n=40)
    return f"{median(ratios):8.3f} ({low:.3f} to {high:.3f})"


def main() -> None:
    """Parse the command line, measure and print."""
    parser = argparse.ArgumentParser(description="CPU time of a frame, and startup time.")
    parser.add_argument("--against", type=Path, metavar="DIR", help="the old checkout")
    parser.add_argument("--scene", action="append", metavar="NAME", help=f"default: {', '.join(SCENES)}")
    parser.add_argument("--turns", type=int, default=5, help="runs of each checkout (default: 5)")
    parser.add_argument("--pipeline", default="pipeline.yaml", help="file or name (default: pipeline.yaml)")
    parser.add_argument("--grasps", type=Path, metavar="DATA", help="instead: recordings of grasps in DATA")
    parser.add_argument("--child", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        settings, recording, results = args.child
        print(json.dumps(measure_frames(args.pipeline, json.loads(settings), Path(recording), Path(results))))
        return
    trees = {"old": args.against.resolve()} if args.against else {}
    trees["new"] = ROOT
    for tree in trees.values():
        finish(tree, "-m", "tactflow", "warmup")
    what = "mean, ms" if args.grasps else "median, ms; p99 / p50"
    print(f"{what:<32}" + "".join(f"{name:>10}{'':>7}" for name in trees) + "   ratio")
    if args.grasps is not None:
        for name, pipeline, pattern, every, settings in GRASPS:
            recordings = sorted(args.grasps.glob(pattern))[::every]
            if not recordings:
                sys.exit(f"--grasps: no {pattern} in {args.grasps}")
            print_means(name, [measure_recording(trees, pipeline, path, settings) for path in recordings])
        return
    with tempfile.TemporaryDirectory() as folder:
        for scene in args.scene or SCENES:
            recording = Path(folder) / f"{scene}.npy".replace("?", "-")
            options = f"{'&' if '?' in scene else '?'}frames={SCENE_FRAMES}"
            finish(ROOT, "-m", "tactflow", "sim", f"{scene}{options}", "--out", str(recording))
            turns = [measure_recording(trees, args.pipeline, recording) for _ in range(args.turns)]
            print_rows(f"{scene}, ", turns)
    print_rows("", [measure_start(trees) for _ in range(args.turns)])


if __name__ == "__main__":
    main()
