"""Degenerate input: pictures and masks that no sensor should give, through every stage and whole pipelines.

Every answer must be defined: finite numbers of the declared types, an absence with a reason, or a refusal in
words. What each stage and pipeline answers to each case is listed.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import tactflow
from tactflow.engine.errors import TactflowError
from tactflow.engine.frame import Absent, Frame
from tactflow.engine.graph import Component
from tactflow.engine.ports import ArrayPort, check_values, fits, port_type
from tactflow.tools.bench import metrics
from tactflow.tools.stress.inputs import MASKS, PICTURES, gel, random_mask, random_picture, tile
from tactflow.tools.stress.parts import Listing, Part, Worst
from tactflow.tools.stress.subjects import Subject
from tactflow.vision.types import Contact, Flow, Markers

Image = NDArray[np.uint8]
Shape = tuple[int, int]

SHAPES: Final[Sequence[Shape]] = ((1, 1), (1, 8), (8, 1), (8, 8), (17, 31), (60, 80), (150, 200), (8, 8000))
"""(H, W) of the pictures, px: from a pixel to a line camera."""
QUICK_SHAPES: Final[Sequence[Shape]] = ((1, 8), (60, 80))
LISTED_SHAPE: Final = (60, 80)
"""The shape whose answers are listed."""
MAX_RANDOM_SIDE_PX: Final = 64
"""Longest side of a picture at random, px."""
MAX_ANSWER_LETTERS: Final = 48
"""Longest answer in a table, characters."""


class UndefinedError(ValueError):
    """An answer has NaN, infinity, or another type than declared."""


def require_defined(value: Any) -> None:
    """Raise UndefinedError for NaN or infinity anywhere, except in standard errors."""
    if value is None or isinstance(value, bool | str | Absent | np.bool_):
        return
    if isinstance(value, int | float | np.number):
        if not np.isfinite(value):
            raise UndefinedError(f"got {value}")
    elif isinstance(value, np.ndarray):
        if value.dtype == object or not np.isfinite(value).all():
            raise UndefinedError("an array has NaN, infinity or objects")
    elif isinstance(value, Markers):
        for part in (value.origin, value.position, value.status):
            require_defined(part)
        if np.isinf(value.stderr).any():
            raise UndefinedError("a standard error is infinite")
        lengths = {len(value.origin), len(value.position), len(value.status), len(value.stderr)}
        if len(lengths) > 1:
            raise UndefinedError(f"lengths of markers differ: {sorted(lengths)}")
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if "stderr" not in field.name and field.name != "probability":
                require_defined(getattr(value, field.name, None))
    elif isinstance(value, tuple | list):
        for part in value:
            require_defined(part)


def answer(value: Any) -> str:
    """A value in a few words."""
    if value is None:
        return "-"
    if isinstance(value, Absent):
        return value.reason
    if isinstance(value, Contact):
        angle = "no direction" if value.angle is None else f"{value.angle:.0f}°"
        return f"area {value.area:.0f}, {angle}"
    if isinstance(value, Markers):
        return f"{len(value.position)} dots"
    if isinstance(value, Flow):
        return "no mean" if value.mean is None else f"mean {math.hypot(*value.mean):.2f} px"
    if isinstance(value, np.ndarray):
        if value.dtype == np.uint8 and value.ndim == 2:
            return f"{100 * np.count_nonzero(value) / max(1, value.size):.0f} % set"
        return f"{value.min():.3g} to {value.max():.3g}" if value.size else "empty"
    return str(value) if isinstance(value, bool | np.bool_ | int | float | str) else type(value).__name__


class Chain:
    """Every stage of the registry, fed with what the others make of a picture.

    Parameters
    ----------
    components : the stages. A stage whose inputs no other stage makes is given the picture or the mask
        where the type fits.
    """

    def __init__(self, components: Sequence[Component]) -> None:
        self._components = components
        self._instances = {component.name: tactflow.stage(component.cls) for component in components}

    def tick(
        self, image: Image, seq: int, fixed: Mapping[str, Any], mask: Image
    ) -> Iterator[tuple[str, Any]]:
        """Run one frame; yields the name of each stage and its outputs, or the exception it raised.

        fixed : port -> value to use instead of what a stage makes of it. mask : for inputs that are masks.
        """
        image.flags.writeable = False
        frame = Frame("main", seq, seq / 30, image, reference=seq == 0)
        known: dict[str, Any] = {"frame": frame, "image": image, **fixed}
        types: dict[str, Any] = {}
        pending = list(self._components)
        for by_type in (False, True):
            while pending:
                ready = next((c for c in pending if self._inputs(c, known, mask, by_type) is not None), None)
                if ready is None:
                    break
                pending.remove(ready)
                found = self._run(ready, self._inputs(ready, known, mask, by_type) or {})
                yield ready.name, found
                for port, value in zip(
                    ready.ports.outputs, found if isinstance(found, list) else (), strict=False
                ):
                    types.setdefault(port.name, port)
                    if not isinstance(value, Absent) and fits(port, types[port.name]):
                        known.setdefault(port.name, value)

    @staticmethod
    def _inputs(
        component: Component, known: Mapping[str, Any], mask: Image, by_type: bool
    ) -> dict[str, Any] | None:
        """Values of the inputs of a stage; None while a required one is missing."""
        values = {}
        for port in component.ports.inputs:
            if port.name in known:
                values[port.name] = known[port.name]
                continue
            kind = port_type(port.annotation)
            if port.optional:
                values[port.name] = None
            elif by_type and isinstance(kind, ArrayPort) and kind.dtype == "uint8":
                values[port.name] = known["image"] if len(kind.shape) == 3 else mask
            else:
                return None
        return values

    def _run(self, component: Component, inputs: Mapping[str, Any]) -> list[Any] | Exception:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found = self._instances[component.name].process(**inputs)
            ports = component.ports.outputs
            outputs = list(found) if isinstance(found, tuple) and hasattr(found, "_fields") else [found]
            if isinstance(found, Absent) or found is None:
                outputs = [found] * len(ports)
            for value in outputs:
                require_defined(value)
            given = [inputs.get(port.name) for port in component.ports.inputs]
            check_values(component.ports, given, outputs)
        except Exception as error:
            return error
        return outputs


def run_degenerate(
    subjects: Sequence[Subject], components: Sequence[Component], *, quick: bool, seed: int = 1
) -> Part:
    """Every case by rule, and cases at random, through stages and pipelines."""
    part = Part(
        "Degenerate input",
        "Pictures and masks by rule and at random, through every stage of the registry and whole pipelines.",
    )
    worst = {component.name: Worst(component.name) for component in components}
    answers: dict[str, dict[str, str]] = {}
    for shape in QUICK_SHAPES if quick else SHAPES:
        for name, mask in MASKS.items() if not quick or shape == LISTED_SHAPE else ():
            part.trials += _try_mask(
                components, worst, name, mask(shape), answers if shape == LISTED_SHAPE else {}
            )
        pairs = [(a, b) for a in PICTURES for b in PICTURES]
        for first, second in pairs[:: 13 if quick else 1] if max(shape) < 1000 else pairs[::9]:
            pictures = [PICTURES[first](shape), PICTURES[second](shape)]
            part.trials += try_pictures(components, worst, f"{first}, then {second}, {shape}", pictures)
    random = np.random.default_rng(seed)
    for number in range(3 if quick else 400):
        shape = (int(random.integers(1, MAX_RANDOM_SIDE_PX)), int(random.integers(1, MAX_RANDOM_SIDE_PX)))
        pictures = [random_picture(random, shape) for _ in range(2)]
        part.trials += try_pictures(components, worst, f"at random, number {number}, {shape}", pictures)
        part.trials += _try_mask(
            components, worst, f"mask at random, number {number}", random_mask(random, shape)
        )
    used = {name for subject in subjects if not subject.reference for name in subject.stages()}
    shapes = {c.name: Worst(c.name, reference=c.name not in used) for c in components}
    _shapes_have_their_direction(components, shapes)
    part.checks += [check for found in (*worst.values(), *shapes.values()) for check in found.checks()]
    stages = [c.name for c in components if any(c.name in row for row in answers.values())]
    part.listings.append(_listing("What each stage answers to a mask", answers, stages))
    _run_pipelines(part, subjects, quick=quick, seed=seed)
    return part


def _listing(title: str, answers: Mapping[str, Mapping[str, str]], columns: Sequence[str]) -> Listing:
    rows = [[case, *(row.get(column, "-") for column in columns)] for case, row in answers.items()]
    return Listing(
        title, ["case", *columns], rows, f"Pictures of {LISTED_SHAPE[1]} x {LISTED_SHAPE[0]} px.", folded=True
    )


def _try_mask(
    components: Sequence[Component],
    worst: Mapping[str, Worst],
    name: str,
    mask: Image,
    answers: dict[str, dict[str, str]] | None = None,
) -> int:
    """Every stage that takes a mask, with this one; a gel without contact around it."""
    shape = mask.shape[:2]
    takes = [c for c in components if any(_is_mask(port.annotation) for port in c.ports.inputs)]
    names = {p.name for c in takes for p in c.ports.inputs if _is_mask(p.annotation)} - {"valid"}
    chain, trials = Chain(components), 0
    # The reference shows no contact; then comes the mask.
    for seq, (picture, shown) in enumerate(((gel().reference, np.zeros_like(mask)), (gel().touched, mask))):
        tiled = tile(picture, shape)
        for stage, found in chain.tick(tiled, seq, dict.fromkeys(names, shown), shown):
            trials += 1
            _judge(worst[stage], found, f"{name}, {shape}")
            if answers is not None and seq and any(c.name == stage for c in takes):
                answers.setdefault(name, {})[stage] = _first(found)
    return trials


def _is_mask(annotation: Any) -> bool:
    kind = port_type(annotation)
    return isinstance(kind, ArrayPort) and kind.dtype == "uint8" and len(kind.shape) == 2


def try_pictures(
    components: Sequence[Component], worst: Mapping[str, Worst], name: str, pictures: Sequence[Image]
) -> int:
    """Every stage, with these frames; the first is the reference."""
    chain, trials = Chain(components), 0
    for seq, picture in enumerate(pictures):
        for stage, found in chain.tick(picture, seq, {}, np.zeros(picture.shape[:2], np.uint8)):
            trials += 1
            _judge(worst[stage], found, name)
    return trials


def _judge(worst: Worst, found: list[Any] | Exception, where: str) -> None:
    undefined = isinstance(found, UndefinedError) or (
        isinstance(found, TypeError | ValueError) and str(found).startswith("port ")
    )
    # Words for the user: an error of the package, or of a vision function about its input.
    refused = (
        isinstance(found, TactflowError)
        or (isinstance(found, ValueError) and not undefined and "required" in str(found))
        or type(found).__module__.startswith("tactflow")
    )
    worst.add("undefined", undefined, f"{where}: {found}" if undefined else where, count=True)
    failed = isinstance(found, Exception) and not undefined and not refused
    text = f"{where}: {type(found).__name__}: {found}" if failed else where
    worst.add("exceptions", failed, text[:200], count=True)


def _first(found: list[Any] | Exception) -> str:
    text = f"refused: {found}" if isinstance(found, Exception) else answer(found[0])
    return text if len(text) <= MAX_ANSWER_LETTERS else text[: MAX_ANSWER_LETTERS - 1] + "…"


def _shapes_have_their_direction(components: Sequence[Component], worst: Mapping[str, Worst]) -> None:
    """A disc has no direction, and a line its own; for every stage that makes a contact of a mask."""
    side = 101
    for component in components:
        found, stage = worst[component.name], tactflow.stage(component.cls)
        y, x = np.mgrid[:side, :side] - side // 2
        makes_contacts = False
        for radius in (5, 9, 16, 30):
            contact = _contact_of(stage, (np.hypot(x, y) <= radius).astype(np.uint8) * np.uint8(255))
            if contact is not None:
                makes_contacts = True
                found.add("disc", contact.angle is not None, f"radius {radius} px", count=True)
        for turn in range(-85, 91, 5) if makes_contacts else ():
            across = x * np.sin(np.radians(turn)) + y * np.cos(np.radians(turn))
            along = x * np.cos(np.radians(turn)) - y * np.sin(np.radians(turn))
            bar = ((np.abs(across) < 3.5) & (np.abs(along) < 40.5)).astype(np.uint8) * np.uint8(255)
            contact = _contact_of(stage, bar)
            angle = None if contact is None else contact.angle
            error = 90.0 if angle is None else metrics.angle_error(angle, float(turn))
            found.add("line", error, f"at {turn} degrees")


def _contact_of(stage: Any, mask: Image) -> Contact | None:
    try:
        found = stage.process(contact_mask=mask)
    except Exception:
        return None
    return found if isinstance(found, Contact) else None


def _run_pipelines(part: Part, subjects: Sequence[Subject], *, quick: bool, seed: int) -> None:
    """Frames of degenerate pictures through whole pipelines; and a picture against itself."""
    answers: dict[str, dict[str, str]] = {}
    random = np.random.default_rng(seed)
    pairs = [(a, b) for a in PICTURES for b in PICTURES][:: 13 if quick else 1]
    shapes = ((60, 80),) if quick else ((1, 8), (8, 8), (60, 80), (150, 200))
    cases = [
        (f"{a}, then {b}", shape, [PICTURES[a](shape), PICTURES[b](shape)])
        for shape in shapes
        for a, b in pairs
    ]
    cases += [("a gel, then black", (128, 176), [gel().reference, PICTURES["black"]((128, 176))])]
    for number in range(2 if quick else 60):
        shape = (int(random.integers(8, MAX_RANDOM_SIDE_PX)), int(random.integers(8, MAX_RANDOM_SIDE_PX)))
        cases.append(
            (f"at random, number {number}", shape, [random_picture(random, shape) for _ in range(2)])
        )
    for subject in subjects:
        worst = Worst(subject.name, reference=subject.reference)
        for name, shape, (first, second) in cases:
            frames = [first, first, second, second]
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    found = subject.run(frames)
                for result in found:
                    require_defined([result.contact, result.flow, result.markers, result.contact_mask])
                    result.to_json(detail=True)
            except Exception as error:
                _judge(worst, error, f"{name}, {shape}")
                text = (
                    f"refused: {str(error).splitlines()[0]}"
                    if isinstance(error, TactflowError)
                    else str(error)
                )
            else:
                worst.add("undefined", 0, "", count=True)
                worst.add("exceptions", 0, "", count=True)
                worst.add("rest", found[1].contact is not None, f"{name}, {shape}", count=True)
                text = answer(found[-1].contact) if found[-1].contact else "no contact"
            part.trials += len(frames)
            if shape == LISTED_SHAPE:
                answers.setdefault(name, {})[subject.name] = text[:MAX_ANSWER_LETTERS]
        part.checks += worst.checks()
    part.listings.append(
        _listing("What each pipeline answers to pictures", answers, [subject.name for subject in subjects])
    )
