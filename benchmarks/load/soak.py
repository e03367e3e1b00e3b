"""A million frames through all sinks as fast as possible: memory, open files and threads, to the end.

    python -m benchmarks.load.soak

writes docs/soak.svg and the section "soak" of docs/reliability.md. Pictures are small, so that it takes an
hour and not ten: what is lost with each frame shows all the same. Old files of the recording are deleted as
new ones are begun.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.load.workload import (
    Sample,
    Subscribers,
    pages,
    running,
    sample,
    write_pipeline,
    write_section,
)
from tests.conftest import REPOSITORY

SIZE = (200, 150)
"""Of the pictures, px."""
LOOK_EVERY = 5.0
"""Time between two looks, s."""
LARGEST_GROWTH = 16.0
"""Memory by which the run may grow after its first tenth, MB."""
PICTURE = REPOSITORY / "docs" / "soak.svg"


@dataclass(frozen=True, slots=True)
class Look:
    """One look at the run. frames : done so far."""

    frames: int
    held: Sample


def sinks(port: int) -> dict[str, dict[str, object]]:
    """All of them."""
    return {
        "zmq": {"endpoint": f"tcp://127.0.0.1:{port}", "wait_for_subscriber": 30},
        "jsonl": {"path": "results.jsonl"},
        "record": {"path": "recording.mcap", "rotate_size": 200},
        "images": {"folder": "images", "format": "jpg", "every": 100},
        "video": {"path": "annotated.mkv", "fps": 60},
        "view": {"port": port + 1},
    }


def soak(frames: int, port: int, folder: Path) -> tuple[list[Look], float]:
    """The looks at a run of so many frames, and how long it took, s."""
    preprocess = {"when": "changed", "rotate": 90}
    write_pipeline(folder, SIZE, {"frames": frames}, {"sinks": sinks(port)})
    looks: list[Look] = []
    subscribers = Subscribers(f"tcp://127.0.0.1:{port}")
    with running(folder, "--set", f"stages.preprocess={preprocess}") as process, subscribers.reading():
        began = time.monotonic()
        while not subscribers.statistics and process.poll() is None:
            time.sleep(0.2)
        with pages([port + 1], 1):
            while process.poll() is None:
                held = sample(process.pid)
                if held is not None:
                    looks.append(Look(subscribers.statistics["frames"], held))
                for old in sorted(folder.glob("recording*.mcap"), key=os.path.getmtime)[:-2]:
                    old.unlink()
                time.sleep(LOOK_EVERY)
        took = time.monotonic() - began
    if process.returncode != 0:
        raise SystemExit((folder / "messages.txt").read_text(encoding="utf-8"))
    with (folder / "results.jsonl").open("rb") as lines:
        count = sum(1 for _ in lines)
    if count != frames:
        raise SystemExit(f"required {frames} lines, got {count}")
    # The last look found a process that was closing what it had open.
    return looks[:-1], took


def report(looks: list[Look], frames: int, took: float) -> str:
    """The section of the page."""
    steady = [look for look in looks if look.frames >= frames / 10]
    rows = [
        f"| {what} | {first:.0f} | {least:.0f} | {most:.0f} | {last:.0f} |"
        for what, values in (
            ("memory, MB", [look.held.memory for look in steady]),
            ("open files", [look.held.files for look in steady]),
            ("threads", [look.held.threads for look in steady]),
        )
        for first, least, most, last in [(values[0], min(values), max(values), values[-1])]
    ]
    growth = steady[-1].held.memory - steady[0].held.memory
    verdict = "grew" if growth > LARGEST_GROWTH else "did not grow"
    return "\n".join(
        [
            f"{frames:,} frames of {SIZE[0]} x {SIZE[1]} px through all sinks (ZeroMQ with a subscriber, "
            f"a page, lines, a recording in files of 200 MB, a film, pictures) in {took / 60:.0f} minutes, "
            f"{frames / took:.0f} a second, the machine's load average {os.getloadavg()[1]:.1f} at the end; "
            f"every frame has its line. Memory {verdict}: "
            f"{growth:+.1f} MB from the first tenth of the run to its end.",
            "",
            "| | after a tenth | least since | most since | at the end |",
            "| --- | --- | --- | --- | --- |",
            *rows,
            "",
            f"![memory, open files and threads over {frames:,} frames](soak.svg)",
            "",
            "`make soak` runs it again.",
        ]
    )


def picture(looks: list[Look], frames: int) -> str:
    """The figure as SVG: one line for each of the three."""
    width, height, left, gap = 900, 120, 70, 34
    parts = []
    for row, (what, values) in enumerate(
        [
            ("memory, MB", [look.held.memory for look in looks]),
            ("open files", [float(look.held.files) for look in looks]),
            ("threads", [float(look.held.threads) for look in looks]),
        ]
    ):
        top = 14 + row * (height + gap)
        most = 1.25 * max(values)
        points = " ".join(
            f"{left + (width - left - 40) * look.frames / frames:.1f},{top + height * (1 - value / most):.1f}"
            for look, value in zip(looks, values, strict=True)
        )
        parts.append(
            f'<rect x="{left}" y="{top}" width="{width - left - 40}" height="{height}" fill="none" '
            f'stroke="#aaa"/><text x="{left - 8}" y="{top + 10}" text-anchor="end">{most:.0f}</text>'
            f'<text x="{left - 8}" y="{top + height}" text-anchor="end">0</text>'
            f'<text x="{left + 8}" y="{top + 16}">{what}</text>'
            f'<polyline points="{points}" fill="none" stroke="#1f4e79" stroke-width="1.6"/>'
        )
    bottom = 14 + 3 * (height + gap)
    parts += [
        f'<text x="{left + (width - left - 40) * tenth / 10:.0f}" y="{bottom - gap + 16}" '
        f'text-anchor="middle">{frames * tenth // 10:,}</text>'
        for tenth in range(0, 11, 2)
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {bottom}" font-family="sans-serif" '
        'font-size="12"><rect width="100%" height="100%" fill="#fff"/>'
        + "\n".join(parts)
        + f'<text x="{width / 2:.0f}" y="{bottom - 2}" text-anchor="middle">frames</text></svg>\n'
    )


def main() -> None:
    """Run it and write what was seen."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--port", type=int, default=5700)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        looks, took = soak(args.frames, args.port, Path(folder))
    PICTURE.write_text(picture(looks, args.frames), encoding="utf-8")
    text = report(looks, args.frames, took)
    print(text)
    write_section("soak", text)


if __name__ == "__main__":
    main()
