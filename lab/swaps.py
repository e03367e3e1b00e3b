"""Compare each stage with what can take its place, and write the page about it.

    tactflow bench --json out/bench.json
    python -m lab.swaps --bench out/bench.json --data RECORDINGS --page docs/swap.md
    python -m lab.swaps --page docs/swap.md --only       # the page again, from the numbers beside it

Named scenes are those of the bench, with the parameters' defaults. On random gels (`lab/wide.py`) and on
real ones, `CHOICES` of parameters are tried: on random gels those that are best for one half are used on the
other half, on real gels those that are best for all other labs. The numbers of parts that are not measured
are kept.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from statistics import median
from types import MappingProxyType, SimpleNamespace
from typing import Any, Final, NamedTuple

import cv2
import numpy as np

from lab.judges import judge, judge_dots
from lab.judges.label_file import load_labels
from lab.peers import contact, dots, page
from lab.peers.common import FAILURES, Numbers, Picture, Settings, combinations, failed, one_thread, search
from lab.peers.dots import FIRST_WIDE_SEED, badness, lose
from lab.wide import WideScene, wide_scene
from tactflow import Frame, Markers, Preprocessor, Result
from tactflow.config.load import load_pipeline
from tactflow.engine.graph import Node, Pipeline
from tactflow.tools.bench import metrics
from tactflow.tools.bench.command import packaged_files
from tactflow.tools.bench.depth import DEPTH, DEPTH_SCENES
from tactflow.tools.bench.methods import STAGES, alternatives
from tactflow.tools.bench.quantities import QUANTITIES, Tally
from tactflow.tools.bench.run import machine
from tactflow.tools.bench.score import MarkerScore
from tactflow.tools.bench.tables import PRIMARY, TITLES
from tactflow.tools.bench.timing import quiet
from tactflow.vision.arrays import Floats
from tactflow.vision.geometry.hull import contact_geometry
from tactflow.vision.markers.lattice import pitch_of

CHOICES: Final[Mapping[str, Mapping[str, Sequence[Any]]]] = {
    "otsu": {"least": (10.0, 5.0, 20.0), "blur": (2.0, 4.0)},
    "mog2": {"threshold": (16.0, 8.0, 32.0), "opening": (9, 21)},
    "knn": {"distance": (20.0, 10.0, 30.0), "opening": (9, 21)},
    "ssim": {"similarity": (0.9, 0.7, 0.97), "window": (1.5, 4.0)},
    "lucas_kanade": {"max_error": (1.0, 0.3), "levels": (3, 1)},
    "rlof": {"max_error": (1.0, 0.3)},
    "dis_flow": {"max_error": (1.0, 3.0), "preset": ("fast", "medium")},
    "adaptive_threshold": {"contrast": (None, 6.0, 20.0)},
    "top_hat": {"contrast": (None, 6.0, 20.0)},
}
"""Stage -> parameter -> values that are tried, the default first."""
STEPS: Final = (0.0, 0.2, 0.4, 0.6, 0.8, 0.2)
"""Largest displacement in each frame of a picture of a real gel that is warped, in distances between
neighbouring dots: a drag, then a jump of more than half a distance."""
SPREAD: Final = 0.25
"""Standard deviation of that displacement around its middle, over the shorter side of the picture."""
NOISE: Final = 1.0
"""Noise added to warped pictures, grey levels: that of a good camera."""
TEMPLATE: Final = Path(__file__).with_name("swaps.md")


@cache
def pipelines() -> dict[str, Pipeline]:
    """The packaged pipelines whose stages are compared, the default one first."""
    files = packaged_files()
    return {name: load_pipeline(files[name]) for name in ("default", "classic")}


def ways(stage: str) -> dict[str, Node]:
    """Name -> way to do the work of a stage, the default one first."""
    return alternatives(pipelines(), stage)


def created(node: Node, settings: Mapping[str, Any] = MappingProxyType({})) -> Any:
    """A new stage, with some parameters changed."""
    return node.component.cls(node.params.changed(**settings))


# Contact: what `difference` finds in a picture, given the reference.


class Pair(NamedTuple):
    """Two pictures, (H, W, 3), whose dots were removed as by default; and where there is gel."""

    untouched: Picture
    unmarked: Picture
    valid: Picture


def without_dots(reference: Picture, picture: Picture, plain: bool) -> Pair:
    """The pair for `difference`. plain : whether the gel has no dots."""
    nodes = pipelines()["default"].nodes
    valid = created(nodes["valid_area"]).process(reference)
    if plain:
        return Pair(reference, picture, valid)
    mask, inpaint = created(nodes["marker_mask"]), created(nodes["inpaint"])
    filled = [inpaint.process(image, mask.process(image, valid)) for image in (reference, picture)]
    return Pair(filled[0], filled[1], valid)


def detect(node: Node, settings: Settings, pair: Pair) -> Picture | None:
    """The contact mask of a picture; None without a contact, or where the stage fails."""
    stage, wanted = created(node, settings), {port.name for port in node.component.ports.inputs}
    found = None
    for seq, image in enumerate((pair.untouched, pair.unmarked)):
        frame = Frame("swap", seq, float(seq), image, reference=seq == 0)
        ports = {"unmarked": image, "frame": frame, "valid": pair.valid}
        try:
            found = stage.process(**{name: ports[name] for name in ports if name in wanted})
        except Exception as error:  # whatever a plug-in raises
            failed(node.component.name, error)
            return None
    return found.contact_mask if found is not None and found.touching else None


def contact_on_wide(count: int) -> dict[str, Any]:
    """Random gels, two pictures of each: parameters chosen on one half, errors on the other."""
    found = (wide_scene(seed) for seed in range(FIRST_WIDE_SEED, FIRST_WIDE_SEED + 2 * count))
    scenes = [
        (without_dots(scene.reference, scene.picture, not scene.dots.any()), scene.contact) for scene in found
    ]

    def errors(node: Node, scenes: Sequence[tuple[Pair, Any]], settings: Settings) -> Numbers:
        tally = Tally()
        for pair, truth in scenes:
            mask = detect(node, settings, pair)
            if truth.any():
                tally.add(contact_iou=0.0 if mask is None else metrics.mask_iou(mask, truth))
                tally.percent(missed_contacts=mask is None)
            else:
                tally.percent(false_contacts=mask is not None)
        return tally.errors()

    answers = {}
    for name, node in ways("difference").items():
        loss = partial(errors, node, scenes[::2])
        settings = search(CHOICES.get(name, {}), lambda tried, loss=loss: contact.overlap_lost(loss(tried)))
        answers[name] = errors(node, scenes[1::2], settings) | {"settings": settings}
    return {"scenes": count, "all": answers}


def contact_on_gels(data: Path) -> dict[str, Any]:
    """Outlines drawn on real gels: each lab with the parameters that are best for all others."""
    pairs = []
    for label in contact.chosen_labels(data):
        reference, picture, mapping = contact.pair(label, data)
        plain = label.recording.startswith(judge.PLAIN)
        pairs.append((label, without_dots(reference, picture, plain), mapping))
    answers = {}
    for name, node in ways("difference").items():
        candidates = {}
        for settings in combinations(CHOICES.get(name, {})):
            judged = []
            for label, pair, mapping in pairs:
                mask = detect(node, settings, pair)
                found = None if mask is None else contact_geometry(mask)
                ports = {"contact": found, "contact_mask": mask, "mapping": mapping}
                judged.append(judge.compare(label, Result(Frame("swap", 1, 1.0, pair.unmarked), ports)))
            candidates[str(settings)] = judged
        answers[name] = contact.summary(contact.chosen_elsewhere(candidates))
    return answers


# Dots: where a tracker says that they are.


def follow(
    node: Node, settings: Settings, pictures: Sequence[Picture], truths: Sequence[Any], tally: Tally
) -> None:
    """Follow the dots of the first picture through the others. Where a stage fails, all dots are lost."""
    score, stage = MarkerScore(tally), created(node, settings)
    wanted = {port.name for port in node.component.ports.inputs}
    for seq, (picture, truth) in enumerate(zip(pictures, truths, strict=True)):
        ports = {"image": picture, "frame": Frame("swap", seq, seq / 30, picture, reference=seq == 0)}
        try:
            markers: Markers = stage.process(**{name: ports[name] for name in ports if name in wanted})
        except Exception as error:  # no dots, says the stage
            failed(node.component.name, error)
            lose(tally, truths[seq:])
            return
        score.add(markers, truth)


def dots_on_wide(count: int) -> dict[str, Any]:
    """Random gels with dots, two pictures of each: parameters chosen on one half, errors on the other."""
    found = (wide_scene(seed) for seed in range(FIRST_WIDE_SEED, FIRST_WIDE_SEED + 4 * count))
    scenes = [scene for scene in found if len(scene.origin) >= 9][: 2 * count]

    def errors(node: Node, scenes: Sequence[WideScene], settings: Settings) -> Numbers:
        tally = Tally()
        for scene in scenes:
            shape = scene.contact.shape
            truths = [_truth(scene.origin, places, shape) for places in (scene.origin, scene.position)]
            follow(node, settings, [scene.reference, scene.picture], truths, tally)
        return tally.errors()

    answers = {}
    for name, node in ways("tracker").items():
        loss = partial(errors, node, scenes[::2])
        settings = search(CHOICES.get(name, {}), lambda tried, loss=loss: badness(loss(tried)))
        answers[name] = errors(node, scenes[1::2], settings) | {"settings": settings}
    return {"scenes": len(scenes[1::2]), "all": answers}


def _truth(origin: Floats, position: Floats, shape: tuple[int, ...]) -> Any:
    visible = ((position >= 0) & (position <= [shape[1] - 1, shape[0] - 1])).all(axis=1)
    return SimpleNamespace(origin=np.float64(origin), position=np.float64(position), visible=visible)


def displaced(points: Floats, shape: tuple[int, ...], farthest: float) -> Floats:
    """Displacement (N, 2), px, of points (N, 2) of a gel that is dragged in the middle of the picture."""
    middle, spread = np.array([shape[1], shape[0]]) / 2, SPREAD * min(shape[:2])
    weight = np.exp(-((points - middle) ** 2).sum(axis=1, keepdims=True) / (2 * spread**2))
    return farthest * weight * np.array([0.8, 0.6])


def warped(picture: Picture, farthest: float, seed: int) -> Picture:
    """A picture of the dragged gel, with noise."""
    y, x = np.indices(picture.shape[:2], np.float64)
    places = np.column_stack([x.ravel(), y.ravel()])
    source = places.copy()
    # The displacement is that of the place at rest: a fixed point, since its slope is below 1.
    for _ in range(12):
        source = places - displaced(source, picture.shape, farthest)
    maps = source.astype(np.float32).reshape(*picture.shape[:2], 2)
    moved = cv2.remap(
        picture, maps[..., 0].copy(), maps[..., 1].copy(), cv2.INTER_CUBIC, None, cv2.BORDER_REFLECT
    )
    noise = np.random.default_rng(seed).normal(0, NOISE, picture.shape)
    return np.clip(np.rint(moved + noise), 0, 255).astype(np.uint8)


def dragged_gels(data: Path) -> Iterator[tuple[str, list[Picture], list[Any]]]:
    """Lab, pictures and truths of each picture of a real gel with marked dots, dragged by `STEPS`."""
    labels = [label for label in load_labels(judge_dots.DOTS) if label.dots]
    for lab, _, picture, sure, uncertain in judge_dots.labelled(labels, data, kinds=[""]):
        height, width = picture.shape[:2]
        prepare = Preprocessor(
            (width, height), downsample=2 if max(width, height) > judge.MAX_WHOLE_SIDE_PX else 1
        )
        image, marked = (
            prepare(picture).copy(),
            prepare.mapping.to_processed(np.concatenate([sure, uncertain])),
        )
        steps = [step * pitch_of(marked) for step in STEPS]
        pictures = [warped(image, step, seed) for seed, step in enumerate(steps)]
        truths = [
            _truth(marked, marked + displaced(marked, image.shape, step), image.shape) for step in steps
        ]
        for truth in truths:
            # Dots that only one of two people marked are neither required nor wrong.
            truth.visible[len(sure) :] = False
        yield lab, pictures, truths


def dots_on_gels(data: Path) -> dict[str, Any]:
    """Dots marked on real gels, followed while the pictures are dragged: each lab with the parameters that
    are best for all others."""
    gels = list(dragged_gels(data))
    answers: dict[str, Any] = {}
    for name, node in ways("tracker").items():
        tallies: dict[str, dict[str, Tally]] = {}
        for settings in combinations(CHOICES.get(name, {})):
            by_lab = tallies[str(settings)] = {}
            for lab, pictures, truths in gels:
                follow(node, settings, pictures, truths, by_lab.setdefault(lab, Tally()))
        whole = Tally()
        for lab in sorted({lab for lab, *_ in gels}):
            chosen = min(tallies, key=lambda key, lab=lab: _badness(tallies[key], lab))
            for key, values in tallies[chosen][lab].values.items():
                whole.values[key] += values
        answers[name] = whole.errors()
    return {"pictures": len(gels), "labs": len({lab for lab, *_ in gels}), "all": answers}


def _badness(by_lab: Mapping[str, Tally], left_out: str) -> tuple[float, float]:
    joined = Tally()
    for lab, tally in by_lab.items():
        if lab != left_out:
            for key, values in tally.values.items():
                joined.values[key] += values
    return badness(joined.errors())


def masks_on_gels(data: Path) -> dict[str, Any]:
    """Dots marked on real gels, found as the spots of a mask, % of them: parameters as for `dots_on_gels`."""
    labels = [label for label in load_labels(judge_dots.DOTS) if label.dots]
    answers = {}
    for name, node in ways("marker_mask").items():

        def find(picture: Picture, settings: Settings, node: Node = node) -> Floats:
            return metrics.mask_centroids(created(node, settings).process(picture))

        judged = [
            list(judge_dots.judge(labels, data, partial(find, settings=settings), kinds=[""]))
            for settings in combinations(CHOICES.get(name, {}))
        ]
        left_out = []
        for lab in sorted({frame.lab for frame in judged[0]}):
            best = min(judged, key=lambda frames, lab=lab: dots.missed(frames, lab, elsewhere=True))
            left_out += [frame for frame in best if frame.lab == lab]
        answers[name] = dots.shares(left_out)
    return answers


def from_bench(path: Path) -> dict[str, Any]:
    """Of a result of the bench: stage -> method -> quantity -> median over the scenes; with `, worst` behind
    the quantity the worst of them; and the number of scenes."""
    values: dict[str, dict[str, dict[str, list[float]]]] = {}
    scenes = set()
    for key, numbers in json.loads(path.read_text(encoding="utf-8"))["values"].items():
        group, *method, scene = key.split("/")
        if group not in (*STAGES, DEPTH):
            continue
        if group in STAGES:
            scenes.add(scene)
        own = values.setdefault(group, {}).setdefault("/".join(method), {})
        for quantity, value in numbers.items():
            own.setdefault(quantity, []).append(value)
    summaries: dict[str, Any] = {"scenes": len(scenes)}
    for group, methods in values.items():
        summaries[group] = {
            name: {key: median(found) for key, found in own.items()}
            | {
                f"{key}, worst": max(own[key], key=QUANTITIES[key].distance)
                for key in own
                if key in QUANTITIES
            }
            for name, own in methods.items()
        }
    return summaries


def write(numbers: Mapping[str, Any], path: Path) -> None:
    """Write the page."""
    tables = {
        name: "\n".join(page.table(numbers, columns, list(ways(stage))))
        for name, (stage, columns) in FRONTS.items()
    }
    stages = []
    for stage in (*STAGES, DEPTH):
        columns = [("ms", f"bench|{stage}|*|contact_ms", ".3g", -1)]
        for key in PRIMARY[stage]:
            quantity = QUANTITIES[key]
            columns.append((quantity.heading, f"bench|{stage}|*|{key}", ".3g", 1 if quantity.best else -1))
        table = page.table(numbers, columns, list(ways(stage)))
        stages += [f"### {TITLES[stage]}: `{stage}`", ""]
        if stage == DEPTH:
            pressed = ", ".join(case.name for case in DEPTH_SCENES[:-1])
            stages += [f"Times are those of a whole frame, scenes {pressed}.", ""]
        stages += [*table, "", *advice(stage), ""]
    values = page.Values(tables | {"stages": "\n".join(stages)})
    values["machine"] = ", ".join(f"{key} {value}" for key, value in numbers["machine"].items())
    values.numbers = numbers
    text = page.Page(TEMPLATE.read_text(encoding="utf-8")).substitute(values)
    path.write_text(text, encoding="utf-8")


def advice(stage: str) -> Iterator[str]:
    """Lines of a list: each registered alternative, and when to take it, by its docstring."""
    for name, node in ways(stage).items():
        paragraphs = inspect.cleandoc(node.component.cls.__doc__ or "").split("\n\n")
        use = [" ".join(paragraph.split()) for paragraph in paragraphs if paragraph.startswith("Use ")]
        if use:
            yield f"- `{node.component.name}`{' (classic)' if name == 'classic' else ''}: {use[0]}"


FRONTS: Final[Mapping[str, tuple[str, Sequence[page.Column]]]] = {
    "dots": (
        "tracker",
        (
            ("ms", "bench|tracker|*|contact_ms", ".2f", -1),
            ("named scenes: RMS px", "bench|tracker|*|displacement_rms", ".3f", -1),
            ("wrong %, worst scene", "bench|tracker|*|wrong_percent, worst", ".1f", -1),
            ("lost %, worst scene", "bench|tracker|*|lost_percent, worst", ".1f", -1),
            ("random gels: RMS px", "dots_wide|all|*|displacement_rms", ".2f", -1),
            ("wrong %", "dots_wide|all|*|wrong_percent", ".1f", -1),
            ("lost %", "dots_wide|all|*|lost_percent", ".1f", -1),
            ("real gels: RMS px", "dots_gels|all|*|displacement_rms", ".3f", -1),
            ("wrong %", "dots_gels|all|*|wrong_percent", ".1f", -1),
            ("lost %", "dots_gels|all|*|lost_percent", ".1f", -1),
        ),
    ),
    "contact": (
        "difference",
        (
            ("ms", "bench|difference|*|contact_ms", ".2f", -1),
            ("named scenes: IoU", "bench|difference|*|contact_iou", ".2f", 1),
            ("false %, worst scene", "bench|difference|*|false_contacts, worst", ".1f", -1),
            ("missed %, worst scene", "bench|difference|*|missed_contacts, worst", ".1f", -1),
            ("random gels: IoU", "contact_wide|all|*|contact_iou", ".2f", 1),
            ("false %", "contact_wide|all|*|false_contacts", ".1f", -1),
            ("missed %", "contact_wide|all|*|missed_contacts", ".1f", -1),
            ("real gels: hull IoU", "contact_gels|*|hull_iou", ".2f", 1),
            ("10 % quantile", "contact_gels|*|worst_tenth", ".2f", 1),
            ("false %", "contact_gels|*|false_contacts", ".1f", -1),
            ("missed %", "contact_gels|*|missed_contacts", ".1f", -1),
        ),
    ),
    "masks": (
        "marker_mask",
        (
            ("ms", "bench|marker_mask|*|contact_ms", ".2f", -1),
            ("named scenes: found, share", "bench|marker_mask|*|marker_recall", ".3f", 1),
            ("detections that are dots, share", "bench|marker_mask|*|marker_precision", ".3f", 1),
            ("real gels: found %", "masks_gels|*|found", ".1f", 1),
            ("false %", "masks_gels|*|false", ".1f", -1),
        ),
    ),
}
"""Table -> stage and columns."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lab.swaps", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real recordings")
    parser.add_argument("--bench", type=Path, default=Path("bench.json"), help="a full run of the bench")
    parser.add_argument("--page", type=Path, default=Path("out/swap.md"), help="the numbers go beside it")
    parser.add_argument("--wide", type=int, default=60, help="random gels that are judged")
    parser.add_argument("--only", nargs="*", metavar="PART", help="measure only these, and keep the others")
    args = parser.parse_args(arguments)
    one_thread()
    parts: dict[str, Callable[[], Any]] = {
        "bench": lambda: from_bench(args.bench),
        "dots_wide": lambda: dots_on_wide(args.wide),
        "dots_gels": lambda: dots_on_gels(args.data),
        "contact_wide": lambda: contact_on_wide(args.wide),
        "contact_gels": lambda: contact_on_gels(args.data),
        "masks_gels": lambda: masks_on_gels(args.data),
    }
    stored = args.page.with_suffix(".json")
    numbers = json.loads(stored.read_text(encoding="utf-8")) if stored.exists() else {}
    args.page.parent.mkdir(parents=True, exist_ok=True)
    with quiet():
        for part in parts if args.only is None else args.only:
            FAILURES.clear()
            numbers[part] = parts[part]()
            counts = {name: dict(errors) for name, errors in FAILURES.items()}
            numbers.setdefault("failures", {})[part] = counts
            numbers["machine"] = machine()
            stored.write_text(json.dumps(numbers, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    write(numbers, args.page)
    return 0


if __name__ == "__main__":
    sys.exit(main())
