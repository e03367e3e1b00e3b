"""Proposals of `tactflow start` for unknown sensors, compared with the pipeline chosen by hand.

    python lab/start.py --data RECORDINGS

Six simulated and twelve recorded sensors, each with `--yes` and nothing but the source. Simulated ones
are judged on another seed, recorded ones on the frames that a person outlined (`lab.judges.judge`). Exit
code 1 if a proposal misses more contacts than the pipeline chosen by hand, or has more false ones.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import yaml

import tactflow
from lab.judges.judge import OUTLINES, Judged, compare, judge
from lab.judges.label_file import FrameLabel, load_labels
from tactflow.system.terminal import show, table
from tactflow.tools.bench.timing import quiet

SIMULATED_SOURCES = {
    "press": "default",
    "unmarked": "markerless",
    "bright_dots": "default",
    "halo": "markerless",
    "painted": "default",
    "mixed": "default",
}
RECORDED_SOURCES = {
    "gels/9dtact_1": "9dtact",
    "gels/digit_fots": "digit",
    "gels/franka_mini/plier-3-0.avi": "mini",
    "gels/gelslim_ball": "gelslim",
    "gels/handmade_dots/video.avi": "default",
    "gels/jar_8_06_1": "markerless",
    "gels/simple_marks": "default",
    "gels/sts_640/video.mp4": "sts",
    "gels/tactip_video": "tactip",
    "gels/thu_real": "markerless",
    "gels/wrs_cam1": "default",
    "wedge_grip/golf_ball_1.avi": "markerless",
}
"""Source -> the pipeline that a person who knows the sensor chooses."""
JUDGED_SEED = 99
"""Seed of the simulated test frames; proposals are made with the default seed."""


def main() -> int:
    """Print the table; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="recordings; left out without it")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these sensors")
    args = parser.parse_args()
    quiet()
    sources = {name: f"sim:{name}?frames=600" for name in SIMULATED_SOURCES}
    for name in RECORDED_SOURCES if args.data is not None else ():
        if (args.data / name).exists():
            sources[name] = str(args.data / name)
        else:
            print(f"{name}: not in {args.data}, left out", file=sys.stderr)
    rows = [("sensor", "proposed", "/", "by hand", "s", "hull IoU", "missed", "false at rest", "says")]
    worse = False
    with tempfile.TemporaryDirectory() as folder:
        for name, source in sources.items():
            if not args.names or name in args.names:
                row, fails = _row(name, source, Path(folder) / "made.yaml", args.data)
                rows.append(row)
                worse = worse or fails
                print(*row, sep="  ", file=sys.stderr, flush=True)
    show(table(rows))
    return int(worse)


def _row(name: str, source: str, out: Path, data: Path | None) -> tuple[tuple[str, ...], bool]:
    """A row of the table, and whether the proposal is worse than the pipeline chosen by hand."""
    by_hand = (SIMULATED_SOURCES | RECORDED_SOURCES)[name]
    words = ["start", source, "--yes", "--no-run", "--overwrite", "--out", str(out)]
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "tactflow", *words], capture_output=True, text=True)
    seconds = f"{time.perf_counter() - begin:.0f}"
    lines = done.stderr.strip().splitlines()
    if done.returncode:
        return (name, f"none ({done.returncode})", "", by_hand, seconds, "", "", "", lines[0]), True
    made = yaml.safe_load(out.read_text(encoding="utf-8"))
    base = out.read_text(encoding="utf-8").splitlines()[0].partition(", from ")[2].partition(".yaml")[0]
    verdicts = [list(_judged(name, pipeline, data)) for pipeline in (str(out), by_hand)]
    numbers = [_numbers(verdict) for verdict in verdicts]
    texts = [f"{_text(mine)} / {_text(hand)}" for mine, hand in zip(*numbers, strict=True)]
    says = next(line for line in lines if "Proposed" in line).strip()
    fails = any(mine > hand for mine, hand in list(zip(*numbers, strict=True))[1:])
    factor = str(made["stages"]["preprocess"]["downsample"])
    return (name, base, factor, by_hand, seconds, *texts, says), fails


def _judged(name: str, pipeline: str, data: Path | None) -> Iterator[Judged]:
    """Compare the results of a pipeline with outlines."""
    if name not in SIMULATED_SOURCES:
        assert data is not None
        labels = [label for label in load_labels(OUTLINES) if label.recording == name]
        yield from judge(pipeline, labels, data)
        return
    settings = {"stages.preprocess.rotate": 0}
    source = f"sim:{name}?frames=300&seed={JUDGED_SEED}"
    scene = tactflow.open_scene(source.removeprefix("sim:"))
    with closing(tactflow.stream(pipeline, source=source, settings=settings)) as results:
        for result in results:
            truth = scene.truth(result.seq)
            hull = () if truth.hull is None else tuple((float(x), float(y)) for x, y in truth.hull)
            label = FrameLabel(
                recording=name,
                frame=result.seq,
                reference=0,
                contact=truth.touching,
                outlines=(hull,) if truth.touching and len(hull) > 2 else (),
            )
            yield compare(label, result)


def _numbers(judged: Sequence[Judged]) -> tuple[float, float, float]:
    """Mean overlap of hulls, % of contacts missed, % of frames at rest with a contact; NaN where unknown."""
    hulls = [frame.hull for frame in judged if not np.isnan(frame.hull)]
    missed = [not frame.found for frame in judged if frame.touched]
    false = [frame.found for frame in judged if not frame.touched]
    mean = [float(np.mean(values)) if values else np.nan for values in (hulls, missed, false)]
    return mean[0], 100 * mean[1], 100 * mean[2]


def _text(number: float) -> str:
    return "-" if np.isnan(number) else f"{number:.3g}"


if __name__ == "__main__":
    sys.exit(main())
