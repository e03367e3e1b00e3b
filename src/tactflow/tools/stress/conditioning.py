"""Conditioning: how much results change with changes of the pictures that mean little, or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactflow.engine.errors import TactflowError
from tactflow.message.result import Result
from tactflow.tools.stress.clips import Clip, cases_for, clip
from tactflow.tools.stress.compare import add_differences, cells, heads, numbers
from tactflow.tools.stress.parts import Listing, Part, Worst
from tactflow.tools.stress.subjects import Subject

Array = NDArray[Any]
Matrix = NDArray[np.float64]

CHANGED_PIXELS: Final = 9
"""Pixels that are changed by a grey level, one in each run."""
MARGIN_PX: Final = 2
"""Border that is cut off so that a picture can be shifted without inventing pixels, px."""
SCENE_COUNT: Final = 2
"""Scenes that each pipeline is run on."""


@dataclass(frozen=True, slots=True)
class Turn:
    """A change of the whole recording that turns results along.

    Attributes
    ----------
    change : of an array (H, W, ...).
    matrix : (3, 3), of pixels, for a picture of size (width, height).
    """

    change: Callable[[Array], Array]
    matrix: Callable[[int, int], Matrix]


def _affine(a: float, b: float, x: float, c: float, d: float, y: float) -> Matrix:
    return np.array([[a, b, x], [c, d, y], [0, 0, 1]], np.float64)


def _inner(right: int, down: int) -> Callable[[Array], Array]:
    def cut(array: Array) -> Array:
        height, width = array.shape[:2]
        top, left = MARGIN_PX - down, MARGIN_PX - right
        return array[top : top + height - 2 * MARGIN_PX, left : left + width - 2 * MARGIN_PX]

    return cut


TURNS: Final[Mapping[str, Turn]] = {
    "turned by 90 degrees": Turn(lambda a: np.rot90(a, -1), lambda _, h: _affine(0, -1, h - 1, 1, 0, 0)),
    "turned by 180 degrees": Turn(lambda a: a[::-1, ::-1], lambda w, h: _affine(-1, 0, w - 1, 0, -1, h - 1)),
    "mirrored": Turn(lambda a: a[:, ::-1], lambda w, _: _affine(-1, 0, w - 1, 0, 1, 0)),
    "exchanged channels": Turn(lambda a: a[..., ::-1] if a.ndim == 3 else a, lambda *_: np.eye(3)),
    "shifted by a pixel": Turn(_inner(1, 1), lambda *_: _affine(1, 0, 1, 0, 1, 1)),
}
"""Name -> change of all pictures. What is shifted is compared with the same inner part of the picture."""


def run_conditioning(
    subjects: Sequence[Subject], *, quick: bool, seed: int = 1, scenes: int = SCENE_COUNT
) -> Part:
    """Every pipeline under changes that mean little. scenes : on so many scenes only."""
    part = Part(
        "Conditioning",
        "The largest change of each number over all frames. One grey level in one pixel and one level of "
        "dither change one frame; turning, mirroring, shifting and exchanging channels "
        "change the whole recording.",
    )
    rows = []
    for subject in subjects:
        worst = Worst(subject.name, reference=subject.reference)
        for case in cases_for(dots=subject.dots, count=1 if quick else scenes):
            whole = clip(case)
            plain = whole.kept(list(range(whole.deepest + 1)))
            try:
                for name, largest, frames in _changes(subject, plain, worst, quick=quick, seed=seed):
                    rows.append([name, case.label, subject.name, *cells(largest)])
                    part.trials += frames
            except TactflowError as error:
                rows.append(["none", case.label, subject.name, str(error).splitlines()[0]])
        part.checks += worst.checks()
    rows.sort(key=lambda row: row[0])
    columns = ["change", "scene", "pipeline", *heads()]
    rows = [row + [""] * (len(columns) - len(row)) for row in rows]
    part.listings.append(Listing("Largest changes of results", columns, rows))
    return part


def _changes(
    subject: Subject, plain: Clip, worst: Worst, *, quick: bool, seed: int
) -> Iterator[tuple[str, dict[str, float], int]]:
    """Yields the name of each change, the largest differences, and how many frames were run."""
    before = _numbers(subject.run(plain.frames))
    last = len(plain.frames) - 1
    random = np.random.default_rng(seed)
    largest: dict[str, float] = {}
    for y, x, channel in _pixels(plain, random, 2 if quick else CHANGED_PIXELS):
        frame = plain.frames[last].copy()
        frame[y, x, channel] += 1 if frame[y, x, channel] < 255 else -1
        after = _numbers(subject.run([*plain.frames[:last], frame]))
        found = add_differences(worst, "pixel", [(before[last], after[last])], f"pixel ({x}, {y})")
        largest |= {key: max(largest.get(key, 0.0), value) for key, value in found.items()}
    yield "one grey level in one pixel", largest, len(plain.frames) * (2 if quick else CHANGED_PIXELS)
    if not quick:
        dither = random.integers(-1, 2, plain.frames[last].shape)
        frame = np.clip(plain.frames[last] + dither, 0, 255).astype(np.uint8)
        after = _numbers(subject.run([*plain.frames[:last], frame]))
        yield (
            "one level of dither",
            add_differences(worst, "dither", [(before[last], after[last])], ""),
            last + 1,
        )
    for name, turn in list(TURNS.items())[: 1 if quick else None]:
        height, width = plain.frames[0].shape[:2]
        start = before
        if name.startswith("shifted"):
            start = _numbers(subject.run([np.ascontiguousarray(_inner(0, 0)(f)) for f in plain.frames]))
        after = _numbers(subject.run([np.ascontiguousarray(turn.change(f)) for f in plain.frames]))
        pairs = list(zip(start, after, strict=True))
        yield name, add_differences(worst, "turn", pairs, name, turn.matrix(width, height)), len(pairs)


def _numbers(results: Sequence[Result]) -> list[dict[str, Any]]:
    return [numbers(result) for result in results]


def _pixels(plain: Clip, random: np.random.Generator, count: int) -> Iterator[tuple[int, int, int]]:
    """Row, column and channel of pixels: on the outline of the contact, on edges of dots, anywhere."""
    truth = plain.truth(len(plain.frames) - 1)[0]
    height, width = plain.frames[0].shape[:2]
    borders = [
        truth.hull,
        truth.position + np.array([5.0, 0.0]),
        random.uniform((0, 0), (width, height), (count, 2)),
    ]
    borders = [border for border in borders if len(border)]
    for number in range(count):
        border = borders[number % len(borders)]
        x, y = border[int(random.integers(len(border)))]
        yield int(np.clip(y, 0, height - 1)), int(np.clip(x, 0, width - 1)), int(random.integers(3))
