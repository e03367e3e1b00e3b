"""The tables of doctor.md: what faults do to the errors, and which of them `tactflow doctor` names.

    python docs/doctor_table.py [RECORDINGS]

Takes about ten minutes. RECORDINGS is a folder of recordings as `tactflow bench --data` takes it.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactflow.bench.gels import present
from tactflow.bench.pipelines import measure_pipelines
from tactflow.bench.quantities import format_number
from tactflow.bench.scenes import Case, Rendered
from tactflow.bench.timing import CopyUnit
from tactflow.config.load import load_pipeline
from tactflow.doctor import Finding, examine, observe
from tactflow.sim import open_scene

Image = NDArray[np.uint8]
Fault = Callable[[Image, float], Image]
PIPELINE = Path(__file__).resolve().parents[1] / "pipeline.yaml"
FRAMES = 60
CHOSEN = ("press", "cable", "bright", "dense", "glossy", "irregular")
"""Scenes on which the bounds were looked at while they were chosen; press alone gave the errors."""
HELD_BACK = ("sparse", "bright_dots", "mixed", "square_dots", "tilted", "worn", "slide", "two")
"""Scenes for the report."""

EFFECTS = (
    *(("blur", f"blur={value}") for value in (0, 1, 2, 3, 4, 6, 8)),
    *(("noise", f"noise={value}") for value in (2, 4, 8, 12, 16)),
    *(("JPEG quality", f"jpeg={value}") for value in (90, 60, 30, 15, 8)),
    *(("bands", f"gain={value}") for value in (0.005, 0.01, 0.02, 0.03, 0.04, 0.05)),
    *(("light that changes", f"drift={value}") for value in (-0.5, 0.3, 0.5)),
    *(("flicker", f"flicker={value}") for value in (0.02, 0.06)),
)


def brighter(image: Image, factor: float) -> Image:
    """Another exposure."""
    return np.asarray(cv2.convertScaleAbs(image, alpha=factor), np.uint8)


def shifted(image: Image, pixels: float) -> Image:
    """The gel has moved to the right."""
    move = np.array([[1, 0, pixels], [0, 1, 0]])
    size = (image.shape[1], image.shape[0])
    return np.asarray(cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def banded(image: Image, moment: float) -> Image:
    """Bands of 5 % that roll."""
    rows = np.arange(len(image)) / len(image)
    gain = 1 + 0.05 * np.sin(2 * np.pi * (2 * rows - 0.37 * moment))
    return np.asarray(np.clip(np.rint(image * gain[:, None, None]), 0, 255), np.uint8)


def compressed(image: Image, _: float) -> Image:
    """JPEG of quality 10."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 10])[1]
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def clipped(image: Image, _: float) -> Image:
    """An exposure at which a quarter of the gel is clipped."""
    return brighter(image, 260.0 / float(np.percentile(image.max(axis=2), 75)))


def blurred(image: Image, _: float) -> Image:
    """Out of focus by a two hundredth of the picture's width."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), image.shape[1] / 200), np.uint8)


FAULTS: dict[str, tuple[str | None, float, Fault]] = {
    "none": (None, 1, lambda image, _: image),
    "blur": ("focus", 1, blurred),
    "clipped": ("clipping", 1, clipped),
    "banding": ("banding", 1, banded),
    "JPEG": ("compression", 1, compressed),
    "low rate": ("rate", 8, lambda image, _: image),
    "drifting gel": ("drift", 1, lambda image, moment: shifted(image, 2.0 * moment / (2 * FRAMES))),
}
"""Fault -> the check that has to name it, by how much the rate falls, and what it does to a frame."""


def effects(folder: Path) -> Iterator[str]:
    """Errors of the default pipeline with each fault."""
    yield "| fault | dots, px | outline, IoU | centre, px | missed dots |"
    yield "| --- | --- | --- | --- | --- |"
    unit = CopyUnit()
    changes: list[tuple[str, str, Callable[[Image, int], Image] | None]] = [(n, q, None) for n, q in EFFECTS]
    changes += [
        ("exposure", f"times {k:g}", lambda image, _, k=k: brighter(image, k))
        for k in (0.15, 0.3, 1.5, 1.7, 2)
    ]
    changes += [
        ("drift", f"{k:g} px", lambda image, i, k=k: shifted(image, k * i / FRAMES)) for k in (0.3, 1.0, 3.0)
    ]
    for name, value, change in changes:
        rendered = Rendered(Case("press", FRAMES, "" if change else value), folder)
        if change:
            for index in range(FRAMES):
                rendered.frames[index] = change(rendered.frames[index], index)
            rendered.frames.flush()
        pipeline = load_pipeline(PIPELINE)
        found = measure_pipelines({"default": pipeline}, rendered, folder, unit, lambda: None)[0]
        keys = ("displacement_rms", "hull_iou", "center_error", "markers_missed")
        cells = [format_number(found.errors[key]) if key in found.errors else "fails" for key in keys]
        yield f"| {name} {value.partition('=')[2] or value} | " + " | ".join(cells) + " |"


def bad(findings: list[Finding]) -> str:
    """The names of the checks that are not content."""
    return ", ".join(f.name for f in findings if f.verdict in ("warning", "fault")) or "-"


def written(frames: list[Image], fps: float, folder: Path) -> Path:
    """A lossless video."""
    path = folder / "recording.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"HFYU"), fps, frames[0].shape[1::-1])
    for frame in frames:
        video.write(frame)
    video.release()
    return path


def named(frames: list[Image], fps: float, folder: Path) -> list[str]:
    """What is named for each fault."""
    cells = []
    for _, slower, change in FAULTS.values():
        changed = [change(image, float(index)) for index, image in enumerate(frames)]
        cells.append(bad(examine(observe(str(written(changed, fps / slower, folder)), 60.0))))
    return cells


def table(sources: dict[str, list[Image]], fps: float, folder: Path) -> Iterator[str]:
    """What is named, by recording and fault."""
    yield "| recording | " + " | ".join(FAULTS) + " |"
    yield "| --- |" + " --- |" * len(FAULTS)
    for name, frames in sources.items():
        yield f"| {name} | " + " | ".join(named(frames, fps, folder)) + " |"


def simulated(scene: str) -> list[Image]:
    """Presses, and a rest at the end."""
    opened = open_scene(f"{scene}?frames={2 * FRAMES}")
    return [opened.frame(index) for index in range(2 * FRAMES)]


def real(data: Path) -> Iterator[str]:
    """What is found on recordings as they are."""
    yield "| recording | named |"
    yield "| --- | --- |"
    sources = [data / "wedge_roll", data / "wedge_ball", *sorted((data / "wedge_grasp").glob("*.avi"))]
    for gel in present(data):
        sources += gel.sources(data / "gels")[::6]
    for source in sources:
        yield f"| {source.relative_to(data)} | {bad(examine(observe(str(source), 60.0)))} |"


def main() -> None:
    """Print the tables."""
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for line in effects(folder):
            print(line, flush=True)
        for scenes in (CHOSEN, HELD_BACK):
            for scene in scenes:
                lines = list(table({scene: simulated(scene)}, 60.0, folder))
                print("\n".join(lines if scene == scenes[0] else lines[2:]), flush=True)
        if len(sys.argv) > 1:
            data = Path(sys.argv[1])
            for line in real(data):
                print(line, flush=True)


if __name__ == "__main__":
    main()
