"""`compare.html`: how two pipelines differ, with the frames in which they differ most."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

from tactflow.api import make_runner
from tactflow.batch.compare import Comparison, Spread, Worst
from tactflow.batch.folder import Folder
from tactflow.batch.page import filled_in, replaced
from tactflow.batch.recordings import Recording
from tactflow.batch.summary import Looker, picture_of, with_looker
from tactflow.engine.errors import TactflowError
from tactflow.engine.graph import Pipeline
from tactflow.message.result import Result

SIDE = 420
"""Longer side of a picture, px. Chosen by hand."""

Opener = Callable[[Recording], Pipeline]
"""Gives a pipeline, without sinks, that reads a recording."""


def write_comparison(
    folder: Folder, comparison: Comparison, names: tuple[str, str], openers: tuple[Opener, Opener]
) -> Path:
    """Write the page; returns its path. The recordings of the worst frames are run again for their pictures.

    names : of the two pipelines. openers : of both.

    Raises
    ------
    StageError : it cannot be written.
    """
    first, second = (_pictures(comparison.worst, opener) for opener in openers)
    worst = "\n".join(_frame(frame, names, first, second) for frame in comparison.worst)
    values = {
        "title": f"{escape(names[1])} against {escape(names[0])}",
        "facts": "\n".join(f"<p>{escape(line)}</p>" for line in described(comparison, names)),
        "numbers": "\n".join(_number(spread) for spread in comparison.spreads.values()),
        "worst": worst or "<p>there is none: no frame has a contact</p>",
    }
    return replaced(folder.path / "compare.html", [filled_in("compare.html", values, scripts=False)])


def described(comparison: Comparison, names: tuple[str, str]) -> list[str]:
    """What a comparison comes to, in lines."""
    first, second = names
    frames = f"{comparison.frames} frames" + (f", {comparison.alone} in one only" if comparison.alone else "")
    lines = [
        f"{frames}; contact in {comparison.both} of both, in {comparison.only_first} of {first} only, in "
        f"{comparison.only_second} of {second} only"
    ]
    if comparison.both:
        lines[0] += f"; outlines overlap by {100 * comparison.overlap:.1f} % (mean, intersection over union)"
    if comparison.scales - {1.0}:
        scales = ", ".join(f"{scale:g}" for scale in sorted(comparison.scales))
        lines.append(f"pixels are those of {first}: what {second} gives was multiplied by {scales}")
    same = [name for name, spread in comparison.spreads.items() if spread.equal == spread.count]
    if same:
        lines.append(f"the same to the bit in all frames: {len(same)} of {len(comparison.spreads)} numbers")
    return lines


def text_table(comparison: Comparison) -> list[str]:
    """The numbers that differ, as lines for a terminal."""
    lines = [f"{'number':32} {'frames':>8} {'mean':>10} {'median':>10} {'95 %':>10} {'largest':>10}"]
    for name, spread in comparison.spreads.items():
        if spread.equal < spread.count:
            values = (spread.mean, spread.quantile(0.5), spread.quantile(0.95), spread.largest)
            lines.append(f"{name:32} {spread.count:8d} " + " ".join(f"{value:10.4g}" for value in values))
    return lines if len(lines) > 1 else []


def _number(spread: Spread) -> str:
    values = (spread.mean, spread.quantile(0.5), spread.quantile(0.95), spread.largest)
    same = f"{100 * spread.equal / spread.count:.0f} %"
    name = f"<b>{spread.column.name}</b><small>{escape(spread.column.description)}</small>"
    cells = [str(spread.count), same, *(f"{value:.4g}" for value in values)]
    return f"<tr><td>{name}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


class _Keep(Looker):
    """Keeps pictures of some frames."""

    def __init__(self, wanted: Iterable[int]) -> None:
        self._wanted = set(wanted)
        self.pictures: dict[int, str] = {}

    def add(self, result: Result) -> None:
        if result.seq in self._wanted:
            self.pictures[result.seq] = picture_of(result, SIDE)


Pictures = Mapping[tuple[str, int], str]
"""(source, seq) -> JPEG in base64."""


def _pictures(worst: Sequence[Worst], opener: Opener) -> Pictures:
    """Pictures of the worst frames by one pipeline."""
    found: dict[tuple[str, int], str] = {}
    for recording in dict.fromkeys(frame.recording for frame in worst):
        seqs = [frame.seq for frame in worst if frame.recording == recording]
        keep = _Keep(seqs)
        pipeline = opener(recording)
        stages = {id_: node for id_, node in pipeline.nodes.items() if node.component.kind != "sink"}
        try:
            make_runner(with_looker(replace(pipeline, nodes=stages), keep), max_frames=max(seqs) + 1).run()
        except TactflowError:
            continue
        found |= {(recording.source, seq): jpeg for seq, jpeg in keep.pictures.items()}
    return found


def _frame(frame: Worst, names: tuple[str, str], first: Pictures, second: Pictures) -> str:
    figures = ""
    for name, pictures in zip(names, (first, second), strict=True):
        jpeg = pictures.get((frame.recording.source, frame.seq))
        picture = "" if jpeg is None else f'<img class="large" alt="" src="data:image/jpeg;base64,{jpeg}">'
        figures += f"<figure>{picture}<figcaption>{escape(name)}</figcaption></figure>"
    where = f"{escape(frame.recording.name)}, frame {frame.seq}, {frame.t:.2f} s"
    overlap = f"outlines overlap by {100 * frame.overlap:.0f} %, the larger has {frame.area:.0f} px²"
    return f'<section><p><b>{where}</b>: {overlap}</p><div class="pictures">{figures}</div></section>'
