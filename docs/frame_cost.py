"""What a frame costs: the section of tuning.md on the cost of a frame, and its picture.

    python docs/frame_cost.py                     writes the section and docs/frame-cost.svg; three minutes
    python docs/frame_cost.py --against DIR       this tree and another one, in turns (A B A B); three minutes
    python docs/frame_cost.py --against DIR --neighbour    the same, beside a program that copies memory

DIR is a clone of the project with a `.venv` of its own. Wants a machine that is otherwise quiet.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import json
import random
import re
import statistics
import subprocess
import sys
import tempfile
import textwrap
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FrameType
from typing import Any

import cv2
import numpy as np

from tactflow.bench.lockstep import LockstepPipeline
from tactflow.bench.pipelines import growth, on_recording
from tactflow.bench.run import GROWTH_FRAMES
from tactflow.bench.scenes import Case, Rendered
from tactflow.bench.timing import BLOCK, CopyUnit, quiet
from tactflow.config.load import load_pipeline
from tactflow.engine.frame import Frame
from tactflow.engine.node import RunningNode
from tactflow.sim import open_scene
from tactflow.vision.compiled import Helper, Kernel

ROOT = Path(__file__).resolve().parents[1]
PAGE, PICTURE = ROOT / "docs" / "tuning.md", ROOT / "docs" / "frame-cost.svg"
BEGIN, END = "<!-- written by docs/frame_cost.py -->", "<!-- end of what docs/frame_cost.py writes -->"
SCENES = ("press", "cable", "dense")
FRAMES, ROUNDS, TURNS = 240, 5, 5
RAW_BYTES = 600 * 800 * 3
PARTS = (
    ("numba, llvmlite", ("numba", "llvmlite")),
    ("tactflow", ("tactflow",)),
    ("numpy", ("numpy",)),
    ("OpenCV", ("cv2",)),
    ("pydantic", ("pydantic", "pydantic_core", "annotated_types", "typing_inspection", "typing_extensions")),
    ("asyncio, ssl", ("asyncio", "ssl")),
    ("the page's server", ("uvicorn", "starlette", "anyio", "h11", "websockets", "click")),
    ("rich", ("rich",)),
    ("ZeroMQ, YAML, orjson", ("zmq", "yaml", "orjson")),
)
"""Rows of the table of imports, and the packages that each of them counts; the rest is Python's own."""


@dataclass
class Call:
    """A call of a stage: its name, begin and end, s, and the bytes of the arrays that it takes and gives.

    native : begin and end of each call of a compiled loop or of OpenCV in it, s.
    """

    name: str
    begin: float
    end: float
    moved: int
    native: list[tuple[float, float]] = field(default_factory=list)


class Watch:
    """Notes every call of a stage, and of compiled loops and OpenCV in it, while it is installed."""

    def __init__(self) -> None:
        self.calls: list[Call] = []
        self._native: list[tuple[float, float]] = []

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Look on within the block."""
        node, kernel = RunningNode.__call__, Kernel.__call__

        def call(this: RunningNode, inputs: Sequence[Any], tick: Any) -> Sequence[Any]:
            self._native = []
            begin = time.perf_counter()
            outputs = node(this, inputs, tick)
            end = time.perf_counter()
            moved = _bytes(inputs) + _bytes(outputs)
            self.calls.append(Call(this.id, begin, end, moved, self._native))
            return outputs

        def timed(function: Callable[..., Any]) -> Callable[..., Any]:
            def run(*args: Any, **options: Any) -> Any:
                begin = time.perf_counter()
                result = function(*args, **options)
                self._native.append((begin, time.perf_counter()))
                return result

            return run

        opencv = {name: value for name, value in vars(cv2).items() if isinstance(value, BuiltinFunctionType)}
        RunningNode.__call__, Kernel.__call__ = call, timed(kernel)  # type: ignore[method-assign, assignment]
        vars(cv2).update({name: timed(value) for name, value in opencv.items()})
        try:
            yield
        finally:
            RunningNode.__call__, Kernel.__call__ = node, kernel  # type: ignore[method-assign]
            vars(cv2).update(opencv)


CHOICES = frozenset({"min", "max", "abs", "round", "rint", "sqrt", "exp", "floor", "hypot"})
"""Functions in compiled loops that count as one operation each."""


class Operations:
    """Counts the operations of compiled loops, which it runs as plain Python beside the compiled ones.

    An operation is an addition, a product, a comparison, a choice or a root, not for an index. Those of NumPy
    and OpenCV are not counted.

    counted : stage -> operations in one frame.
    """

    def __init__(self) -> None:
        self.counted: Counter[str] = Counter()
        self._lines: dict[CodeType, dict[int, int]] = {}
        self._found = 0

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Count within the block, which takes a thousand times as long."""
        node, kernel = RunningNode.__call__, Kernel.__call__

        def call(this: RunningNode, inputs: Sequence[Any], tick: Any) -> Sequence[Any]:
            self._found = 0
            outputs = node(this, inputs, tick)
            self.counted[this.id] = self._found
            return outputs

        def loop(this: Kernel[..., Any], *args: Any) -> Any:
            copies = [value.copy() if isinstance(value, np.ndarray) else value for value in args]
            before = sys.gettrace()
            sys.settrace(self._enter)
            try:
                # Sums of small integers overflow here, where numba's are wider.
                with np.errstate(all="ignore"):
                    this.plain(*copies)
            finally:
                sys.settrace(before)
            return kernel(this, *args)

        RunningNode.__call__, Kernel.__call__ = call, loop  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            RunningNode.__call__, Kernel.__call__ = node, kernel  # type: ignore[method-assign]

    def _enter(self, frame: FrameType, _event: str, _: Any) -> Any:
        """Trace function: what to do with a function that begins."""
        code = frame.f_code
        if "tactflow" not in code.co_filename or code is Helper.__call__.__code__:
            return None
        if code not in self._lines:
            self._lines[code] = operations_by_line(code)
        lines = self._lines[code]

        def line(frame: FrameType, event: str, _: Any) -> Any:
            if event == "line":
                self._found += lines.get(frame.f_lineno, 0)
            return line

        return line


def operations_by_line(code: CodeType) -> dict[int, int]:
    """Line of a function -> operations in it, apart from those for an index or the bounds of a loop."""
    source, first = inspect.getsourcelines(code)
    found: Counter[int] = Counter()

    def visit(node: ast.AST) -> None:
        if isinstance(node, ast.BinOp | ast.AugAssign | ast.Compare | ast.IfExp):
            found[node.lineno + first - 1] += 1
        elif isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            found[node.lineno + first - 1] += name in CHOICES
        passed = {"slice", "decorator_list", "args"} if isinstance(node, ast.FunctionDef) else {"slice"}
        if isinstance(node, ast.For):
            passed = {"iter"}
        for name, value in ast.iter_fields(node):
            for child in value if isinstance(value, list) else [value]:
                if name not in passed and isinstance(child, ast.AST):
                    visit(child)

    visit(ast.parse(textwrap.dedent("".join(source))))
    return found


def operations(folder: Path) -> Counter[str]:
    """Stage -> operations of its compiled loops in the deepest frame of `press`."""
    pipeline = on_recording(load_pipeline(ROOT / "pipeline.yaml"), recording("press", folder))
    run = LockstepPipeline(pipeline, folder / "out.jsonl")
    for _ in range(FRAMES // 2):
        run.step()
    counter = Operations()
    with counter.installed():
        run.step()
    run.close()
    return counter.counted


def additions_per_second() -> float:
    """How many bytes the machine adds in a second, from and to its second cache: no type is faster."""
    first, second, third = np.ones((3, 1 << 17), np.uint8)
    times = []
    for _ in range(2000):
        began = time.perf_counter()
        np.add(first, second, out=third)
        times.append(time.perf_counter() - began)
    return first.size / statistics.median(times)


def _bytes(values: Sequence[Any]) -> int:
    """Bytes of the arrays among these values, each once; a frame counts only where no picture is given."""
    arrays = {id(value): value.nbytes for value in values if isinstance(value, np.ndarray)}
    frames = [value.image.nbytes for value in values if isinstance(value, Frame)]
    return sum(arrays.values()) or sum(frames)


def recording(scene: str, folder: Path) -> Path:
    """The scene as a file."""
    path = folder / f"{scene}.npy"
    if not path.exists():
        shown = open_scene(f"{scene}?frames={FRAMES}")
        np.save(path, np.stack([shown.frame(index) for index in range(FRAMES)]))
    return path


def frames_of(
    scene: str, folder: Path, unit: CopyUnit, tree: Path = ROOT
) -> tuple[dict[str, float], list[list[Call]]]:
    """CPU time of a frame with contact and of one without, ms; and the calls of each frame with contact."""
    pipeline = on_recording(load_pipeline(tree / "pipeline.yaml"), recording(scene, folder))
    times: dict[str, list[float]] = {"contact": [], "idle": []}
    found: list[list[Call]] = []
    watch = Watch()
    with watch.installed(), quiet():
        run = LockstepPipeline(pipeline, folder / "out.jsonl")
        while outcomes := run.block(BLOCK):
            unit.take(BLOCK)
            # A frame's calls end with the one of the sink that keeps the results.
            ends = [i + 1 for i, call in enumerate(watch.calls) if call.name == "bench"]
            parts = [watch.calls[a:b] for a, b in zip([0, *ends], ends, strict=False)]
            watch.calls.clear()
            for outcome, calls in zip(outcomes, parts, strict=True):
                if not outcome.frame.reference:
                    times["idle" if outcome.contact is None else "contact"].append(1e3 * outcome.cpu)
                    if outcome.contact is not None:
                        found.append(calls)
        run.close()
    return {kind: statistics.median(values) for kind, values in times.items() if values}, found


def write_page() -> None:
    """Measure, and write the section and the picture."""
    unit = CopyUnit()
    rows: dict[str, dict[str, list[float]]] = {}
    moved: dict[str, int] = {}
    lines: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        worked = operations(Path(name))
        for scene in SCENES:
            stages: dict[str, list[float]] = defaultdict(list)
            native: list[float] = []
            best: dict[str, float] = {}
            for _ in range(ROUNDS):
                times, frames = frames_of(scene, Path(name), unit)
                best = {kind: min(value, best.get(kind, value)) for kind, value in times.items()}
                for calls in frames:
                    native.append(1e3 * sum(end - begin for call in calls for begin, end in call.native))
                    for call in calls:
                        stages[call.name].append(1e3 * (call.end - call.begin))
                        moved[call.name] = call.moved
                if scene == "press":
                    PICTURE.write_text(picture(typical(frames)), encoding="utf-8")
            rows[scene] = stages
            told = "; ".join(
                f"{kind} {ms:.2f} ms, {ms / unit.copy_ms:.1f} copies" for kind, ms in best.items()
            )
            lines.append(
                f"- `{scene}`: {told}; contact in loops and OpenCV {statistics.median(native):.2f} ms."
            )
        pipeline = load_pipeline(ROOT / "pipeline.yaml")
        grown = growth(pipeline, Rendered(Case("press", GROWTH_FRAMES), Path(name)), Path(name), unit)
    assert grown is not None
    lines.append(f"- `press` at 1600 x 1200 with 560 dots: {grown:.2f} times as long as at 800 x 600.")
    rate = additions_per_second()
    roofline = f"The machine adds {rate / 1e9:.0f} billion bytes a second from its second cache.\n"
    table = _stages(rows, moved, worked, unit, rate)
    text = "\n".join([_intro(unit), *lines, "", roofline, table, "", _imports()])
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{after}", encoding="utf-8")


def _intro(unit: CopyUnit) -> str:
    return (
        f"One copy of a raw frame, {RAW_BYTES / 1e6:.2f} MB, took {unit.copy_ms:.3f} ms, that is "
        f"{2 * RAW_BYTES / unit.copy_ms / 1e6:.0f} GB/s read and written; a page of fresh memory "
        f"{unit.fault_us:.1f} µs. CPU time of a frame, the median of {FRAMES} frames, the least of "
        f"{ROUNDS} runs:\n"
    )


def _stages(
    rows: dict[str, dict[str, list[float]]],
    moved: dict[str, int],
    worked: Counter[str],
    unit: CopyUnit,
    rate: float,
) -> str:
    times = " | ".join(f"`{scene}`, ms" for scene in rows)
    header = [
        f"| stage | {times} | moves, MB | operations, millions | bound, ms | times |",
        "| --- |" + " --- |" * (len(rows) + 4),
    ]
    body = []
    for name in rows["press"]:
        if name == "bench":
            continue
        own = [
            statistics.median(stages[name]) if name in stages else float("nan") for stages in rows.values()
        ]
        bound = max(moved[name] / (2 * RAW_BYTES) * unit.copy_ms, 1e3 * worked[name] / rate)
        cells = [f"`{name}`", *(f"{ms:.3f}" for ms in own), f"{moved[name] / 1e6:.2f}"]
        cells += [f"{worked[name] / 1e6:.2f}" if worked[name] else "-", f"{bound:.3f}"]
        body.append("| " + " | ".join([*cells, f"{own[0] / bound:.1f}" if bound > 0 else "-"]) + " |")
    return "\n".join(header + body)


def typical(frames: list[list[Call]]) -> list[Call]:
    """The frame whose calls take the median time together."""
    return sorted(frames, key=lambda calls: sum(call.end - call.begin for call in calls))[len(frames) // 2]


def picture(calls: list[Call]) -> str:
    """One frame as an SVG: when each stage ran, and in it what is not Python."""
    start, end = calls[0].begin, calls[-1].end
    wide, left, high = 900, 110, 22
    scale = (wide - left - 70) / (end - start)
    rows = [call for call in calls if call.name != "bench"]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" height="{high * len(rows) + 46}" '
        'font-family="sans-serif" font-size="12">',
        '<rect width="100%" height="100%" fill="white"/>',
    ]
    for number, call in enumerate(rows):
        y, x, width = high * number + 8, left + scale * (call.begin - start), scale * (call.end - call.begin)
        parts += [
            f'<text x="{left - 8}" y="{y + 13}" text-anchor="end">{call.name}</text>',
            f'<rect x="{x:.1f}" y="{y}" width="{max(width, 1):.1f}" height="{high - 6}" fill="#9ecae1"/>',
            *(
                f'<rect x="{left + scale * (a - start):.1f}" y="{y}" width="{max(scale * (b - a), 0.5):.1f}" '
                f'height="{high - 6}" fill="#08519c"/>'
                for a, b in call.native
            ),
            f'<text x="{x + width + 5:.1f}" y="{y + 13}" fill="#555">{1e3 * width / scale:.2f}</text>',
        ]
    y = high * len(rows) + 12
    step = 0.5e-3
    for tick in range(int((end - start) / step) + 1):
        x = left + scale * tick * step
        parts += [
            f'<line x1="{x:.1f}" y1="4" x2="{x:.1f}" y2="{y}" stroke="#ccc" stroke-width="0.5"/>',
            f'<text x="{x:.1f}" y="{y + 14}" text-anchor="middle" fill="#555">{tick * 0.5:g} ms</text>',
        ]
    return "\n".join([*parts, "</svg>\n"])


def _imports() -> str:
    """A table of what `tactflow run` imports until its second frame, and how long it runs."""
    command = ["-m", "tactflow", "run", str(ROOT / "pipeline.yaml"), "--max-frames", "2", "--quiet"]
    command += ["--set", "sinks.jsonl.path=/dev/null"]
    least: dict[str, float] = {}
    walls: list[float] = []
    for _ in range(ROUNDS):
        shown = _run(["-X", "importtime", *command])
        for micros, module in re.findall(r"import time: +(\d+) \| +\d+ \| +(\S+)", shown):
            least[module] = min(float(micros), least.get(module, float("inf")))
        began = time.perf_counter()
        _run(command)
        walls.append(time.perf_counter() - began)
    of_part = {package: part for part, packages in PARTS for package in packages}
    sums: dict[str, float] = defaultdict(float)
    for module, micros in least.items():
        sums[of_part.get(module.split(".")[0], "Python's own and others")] += micros / 1e3
    rows = [f"| {part} | {ms:.0f} |" for part, ms in sorted(sums.items(), key=lambda item: -item[1])]
    text = f"`tactflow run` of two frames takes {min(walls):.2f} s, kernels on disk. Of that, imports:"
    rows.append(f"| all | {sum(sums.values()):.0f} |")
    return "\n".join([text, "", "| imported | ms |", "| --- | --- |", *rows])


def _run(arguments: list[str]) -> str:
    """Run Python with these arguments; returns what it said on standard error."""
    done = subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stderr


def one_turn(folder: Path) -> dict[str, float]:
    """`SCENE kind` -> CPU time of a frame, ms, and `copy`."""
    unit = CopyUnit()
    found = {
        f"{scene} {kind}": ms
        for scene in SCENES
        for kind, ms in frames_of(scene, folder, unit, Path.cwd())[0].items()
    }
    return {**found, "copy": unit.copy_ms}


def compare(other: Path, *, neighbour: bool) -> None:
    """Print this tree and another one in turns: times, and their ratio with its interval of 95 %."""
    found: dict[Path, list[dict[str, float]]] = {other: [], ROOT: []}
    copying = "import numpy as np\na = np.ones((64, 1 << 20)); b = a.copy()\nwhile True: np.copyto(a, b)"
    beside = subprocess.Popen([sys.executable, "-c", copying]) if neighbour else None
    try:
        with tempfile.TemporaryDirectory() as folder:
            for scene in SCENES:
                recording(scene, Path(folder))
            for turn in range(TURNS + 1):
                for tree in found:
                    command = [str(tree / ".venv" / "bin" / "python"), __file__, "--turn", folder]
                    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True)
                    # The first turn compiles.
                    if turn:
                        found[tree].append(json.loads(done.stdout.splitlines()[-1]))
    finally:
        if beside is not None:
            beside.kill()
            beside.wait()
    print("| frame | other, ms | this, ms | copies | ratio |\n| --- | --- | --- | --- | --- |")
    copy = statistics.median(turn["copy"] for turn in found[ROOT])
    for name in found[ROOT][0]:
        old, new = ([turn[name] for turn in found[tree]] for tree in found)
        low, high = _interval(old, new)
        before, now = statistics.median(old), statistics.median(new)
        times = f"{before:.3f} | {now:.3f} | {now / copy:.1f}"
        print(f"| {name} | {times} | {now / before:.2f} ({low:.2f} to {high:.2f}) |")


def _interval(old: Sequence[float], new: Sequence[float]) -> tuple[float, float]:
    """Of the ratio of medians, by bootstrap."""
    draw = random.Random(0)
    ratios = sorted(
        statistics.median(draw.choices(new, k=len(new))) / statistics.median(draw.choices(old, k=len(old)))
        for _ in range(2000)
    )
    return ratios[50], ratios[1949]


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, metavar="DIR", help="a tree to compare with")
    parser.add_argument("--neighbour", action="store_true", help="beside a program that copies memory")
    parser.add_argument("--turn", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.turn is not None:
        print(json.dumps(one_turn(args.turn)))
    elif args.against is not None:
        compare(args.against.resolve(), neighbour=args.neighbour)
    else:
        write_page()


if __name__ == "__main__":
    main()
