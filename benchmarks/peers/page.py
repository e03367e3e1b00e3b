"""The page about the numbers, and its plot. `page.md` has its words; every number comes from peers.json."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, Final

Numbers = Mapping[str, Any]
Column = tuple[str, Callable[[str], float | None], str, int]
"""Heading; value of a method, None where there is none; format; 1 if more is better, -1 if less is."""
TEMPLATE: Final = Path(__file__).with_name("page.md")
PLURAL: Final = {"dots_wide": "dots, random sensors", "contact": "contact, named scenes"} | {
    "contact_wide": "contact, random sensors"
}


def write(numbers: Numbers, path: Path) -> None:
    """The page, and the plot beside it."""
    plot(numbers, path.with_suffix(".jpg"))
    path.write_text(text(numbers, path.with_suffix(".jpg").name), encoding="utf-8")


def text(numbers: Numbers, picture: str) -> str:
    """The page, Markdown."""
    contact, dots = numbers["contact"]["all"], numbers["dots"]["all"]
    ours = [name for name in contact if name.startswith("tactflow")]
    rows = [*ours, "tactflow, chosen", *(name for name in contact if name not in ours)]
    tables = {
        "machine": [", ".join(f"{key} {value}" for key, value in numbers["machine"].items())],
        "better": ["; ".join(better(numbers))],
        "picture": [picture],
        "dots": table(dots_columns(numbers), list(dots)),
        "dots_scenes": scene_table(numbers["dots"]["scenes"], dot_cell),
        "contact": table(contact_columns(numbers), rows),
        "contact_scenes": scene_table(
            numbers["contact"]["scenes"], lambda errors: f"{errors['contact_iou']:.2f}"
        ),
        "depth": depth_table(numbers["depth"]),
        "settings": settings(numbers),
        "attempts": attempts(numbers["attempts"]),
        "failures": failures(numbers["failures"]),
    }
    return Page(TEMPLATE.read_text(encoding="utf-8")).substitute(Values(numbers, tables))


class Page(Template):
    """A text with `$name` for a table and `${path of a number:format}`."""

    braceidpattern = r"[^}]+"


class Values(dict[str, str]):
    """What stands in the page: tables, and every number by its path in the file, "-" where there is none."""

    def __init__(self, numbers: Numbers, tables: Mapping[str, Iterable[str]]) -> None:
        super().__init__({name: "\n".join(lines) for name, lines in tables.items()})
        self._numbers = numbers

    def __missing__(self, key: str) -> str:
        path, _, form = key.partition(":")
        value: Any = self._numbers
        for step in path.split("|"):
            value = value.get(step, {})
        return format(value, form) if value != {} else "-"


def table(columns: Sequence[Column], methods: Sequence[str]) -> Iterator[str]:
    """Lines of a table with a row for each method, the first of which is the one to beat."""
    yield "| | " + " | ".join(heading for heading, *_ in columns) + " |"
    yield "| --- |" + " --- |" * len(columns)
    for method in methods:
        cells = [_cell(value(method), value(methods[0]), form, sign) for _, value, form, sign in columns]
        yield f"| {method} | " + " | ".join(cells) + " |"


def _cell(value: float | None, ours: float | None, form: str, sign: int) -> str:
    if value is None:
        return "-"
    shown = format(value, form)
    better = ours is not None and sign * (float(shown) - float(format(ours, form))) > 0
    return f"**{shown}**" if better else shown


def _of(part: Any, key: str) -> Callable[[str], float | None]:
    return lambda method: (part or {}).get(method, {}).get(key)


def _plain(part: Any, prefix: str = "") -> Callable[[str], float | None]:
    return lambda method: (part or {}).get(prefix + method)


def dots_columns(numbers: Numbers) -> list[Column]:
    """Columns of the table of dots."""
    named, wide = numbers["dots"]["all"], numbers["dots_wide"]["all"]
    gels = numbers.get("dots_gels", {})
    found = {name: shares["other labs"] for name, shares in gels.items()}
    same = {name: shares["same lab"] for name, shares in gels.items()}
    return [
        ("named scenes: RMS px", _of(named, "displacement_rms"), ".3f", -1),
        ("wrong %", _of(named, "wrong_percent"), ".1f", -1),
        ("lost %", _of(named, "lost_percent"), ".1f", -1),
        ("random sensors: RMS px", _of(wide, "displacement_rms"), ".2f", -1),
        ("wrong %", _of(wide, "wrong_percent"), ".1f", -1),
        ("lost %", _of(wide, "lost_percent"), ".1f", -1),
        ("real gels: found %", _of(found, "found"), ".1f", 1),
        ("false %", _of(found, "false"), ".1f", -1),
        ("set for the very sensor: found %", _of(same, "found"), ".1f", 1),
        ("false %", _of(same, "false"), ".1f", -1),
        ("ms", _plain(numbers["dots"]["ms"]), ".2f", -1),
        ("MB", _plain(numbers.get("memory"), "dots/"), ".0f", -1),
        ("lines", _plain(numbers.get("code"), "dots/"), ".0f", -1),
    ]


def contact_columns(numbers: Numbers) -> list[Column]:
    """Columns of the table of contacts."""
    named, wide, gels = (
        numbers["contact"]["all"],
        numbers["contact_wide"]["all"],
        numbers.get("contact_gels", {}),
    )
    return [
        ("named scenes: IoU", _of(named, "contact_iou"), ".2f", 1),
        ("false %", _of(named, "false_contacts"), ".1f", -1),
        ("missed %", _of(named, "missed_contacts"), ".1f", -1),
        ("random sensors: IoU", _of(wide, "contact_iou"), ".2f", 1),
        ("false %", _of(wide, "false_contacts"), ".1f", -1),
        ("missed %", _of(wide, "missed_contacts"), ".1f", -1),
        ("real gels: hull IoU, median", _of(gels, "hull_iou"), ".2f", 1),
        ("10 % quantile", _of(gels, "worst_tenth"), ".2f", 1),
        ("false %", _of(gels, "false_contacts"), ".1f", -1),
        ("missed %", _of(gels, "missed_contacts"), ".1f", -1),
        ("ms", _plain(numbers["contact"]["ms"]), ".1f", -1),
        ("MB", _plain(numbers.get("memory"), "contact/"), ".0f", -1),
        ("lines", _plain(numbers.get("code"), "contact/"), ".0f", -1),
    ]


def scene_table(scenes: Numbers, cell: Callable[[Numbers], str]) -> Iterator[str]:
    """Lines of a table with a row for each scene."""
    methods = list(next(iter(scenes.values())))
    yield "| scene | " + " | ".join(methods) + " |"
    yield "| --- |" + " --- |" * len(methods)
    for scene, answers in scenes.items():
        yield f"| {scene} | " + " | ".join(cell(answers[method]) for method in methods) + " |"


def dot_cell(errors: Numbers) -> str:
    """RMS, px (wrong or lost, %)."""
    bad = errors["wrong_percent"] + errors["lost_percent"]
    rms = f"{errors['displacement_rms']:.3f}" if "displacement_rms" in errors else "-"
    return f"{rms} ({bad:.1f})" if f"{bad:.1f}" != "0.0" else rms


def depth_table(sets: Numbers) -> Iterator[str]:
    """Lines of a table with a row for each set of presses."""
    methods = [key for key in next(iter(sets.values())) if key != "presses"]
    heads = {"normals": "normals, deg", "cap": "cap, %", "ms": "ms", "learning_s": "s to learn"}
    yield (
        "| balls | presses judged | "
        + " | ".join(f"{m}: {h}" for h in heads.values() for m in methods)
        + " |"
    )
    yield "| --- | --- |" + " --- |" * len(heads) * len(methods)
    for name, answers in sets.items():
        cells = [
            _cell(answers[m][key], answers[methods[0]][key], ".1f", -1) for key in heads for m in methods
        ]
        yield f"| {name} | {answers['presses']} | " + " | ".join(cells) + " |"


def settings(numbers: Numbers) -> Iterator[str]:
    """Lines about the settings that were found."""
    for part, what in PLURAL.items():
        found = {
            name: errors["settings"] for name, errors in numbers[part]["all"].items() if errors["settings"]
        }
        yield f"- {what}: " + "; ".join(f"{name}: {_pairs(values)}" for name, values in found.items())
    every: dict[str, dict[str, set[Any]]] = {}
    for answers in numbers["dots"]["scenes"].values():
        for name, errors in answers.items():
            for key, value in errors["settings"].items():
                every.setdefault(name, {}).setdefault(key, set()).add(value)
    ranges = {
        n: {k: " or ".join(map(str, sorted(v))) for k, v in found.items()} for n, found in every.items()
    }
    shown = "; ".join(f"{name}: {_pairs(values)}" for name, values in ranges.items())
    yield f"- dots, named scenes (`peers.json` has those of each scene): {shown}"


def _pairs(values: Numbers) -> str:
    return ", ".join(f"{key} {value}" for key, value in values.items())


def attempts(tried: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Lines of a table of packages that were tried in vain."""
    yield "| package | tried | outcome |"
    yield "| --- | --- | --- |"
    for one in tried:
        yield f"| {one['package']} {one['version']} | `{one['tried']}` | {one['error']} |"


def failures(parts: Numbers) -> Iterator[str]:
    """Lines about errors, counted by part, method and kind."""
    counts: dict[tuple[str, str, str], int] = {}
    for part, methods in parts.items():
        for method, messages in methods.items():
            for message, count in messages.items():
                kind = "no dots were found" if "NoMarkersError" in message else message
                counts[part, method, kind] = counts.get((part, method, kind), 0) + count
    for (part, method, kind), count in counts.items():
        yield f"- {part.replace('_', ', ')}: {method}, {count} x {kind}"


def better(numbers: Numbers) -> Iterator[str]:
    """What a peer does better than tactflow's default: every number that is bold in the tables."""
    dots, contact = list(numbers["dots"]["all"]), list(numbers["contact"]["all"])
    for what, columns, methods in (
        ("dots", dots_columns(numbers), dots),
        ("contact", contact_columns(numbers), contact),
    ):
        kind = ""
        for heading, value, form, sign in columns:
            kind = heading.partition(": ")[0] if ": " in heading else kind
            name = heading if ": " in heading or heading in ("ms", "MB", "lines") else f"{kind}: {heading}"
            ours = value(methods[0])
            for method in methods[1:]:
                shown = _cell(value(method), ours, form, sign)
                if (
                    shown.startswith("**")
                    and not method.startswith("tactflow")
                    and heading not in ("MB", "lines")
                ):
                    yield f"{method}, {what}, {name}: {shown.strip('*')} instead of {ours:{form}}"
    for name, answers in numbers["depth"].items():
        methods = [key for key in answers if key != "presses"]
        for key, heading in (("normals", "normals, deg"), ("cap", "cap, %")):
            for method in methods[1:]:
                shown = _cell(answers[method][key], answers[methods[0]][key], ".1f", -1)
                if shown.startswith("**"):
                    ours = answers[methods[0]][key]
                    yield f"{method}, {name}, {heading}: {shown.strip('*')} instead of {ours:.1f}"


def plot(numbers: Numbers, path: Path) -> None:
    """Time against error: dots, contact, normals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), constrained_layout=True)
    panels: list[tuple[str, str, Numbers, dict[str, Callable[[str], float | None]]]] = [
        (
            "Dots: RMS error, px",
            "log",
            numbers["dots"]["ms"],
            {
                "named scenes": _of(numbers["dots"]["all"], "displacement_rms"),
                "random sensors": _of(numbers["dots_wide"]["all"], "displacement_rms"),
            },
        ),
        (
            "Contact: 1 - overlap",
            "linear",
            numbers["contact"]["ms"],
            {
                "named scenes": _lost(numbers["contact"]["all"], "contact_iou"),
                "random sensors": _lost(numbers["contact_wide"]["all"], "contact_iou"),
                "real gels (hulls)": _lost(numbers.get("contact_gels"), "hull_iou"),
            },
        ),
    ]
    if "depth" in numbers:
        methods = [key for key in next(iter(numbers["depth"].values())) if key != "presses"]
        mean_ms = {
            m: sum(s[m]["ms"] for s in numbers["depth"].values()) / len(numbers["depth"]) for m in methods
        }
        sets = {name: _of(answers, "normals") for name, answers in numbers["depth"].items()}
        panels.append(("Normals: error, degrees", "linear", mean_ms, sets))
    for axis, (title, scale, ms, kinds) in zip(axes, panels, strict=True):
        for number, method in enumerate(ms):
            for marker, value in zip("osD^v", kinds.values(), strict=False):
                error = value(method)
                if error is not None:
                    label = method if marker == "o" else None
                    axis.plot(ms[method], error, marker, color=f"C{number}", label=label, markersize=8)
        for marker, kind in zip("osD^v", kinds, strict=False):
            axis.plot([], [], marker, color="0.5", label=kind)
        axis.set(title=title, xlabel="ms per picture", xscale="log", yscale=scale, xlim=(0.03, 300))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=90, pil_kwargs={"quality": 85})
    plt.close(figure)


def _lost(part: Any, key: str) -> Callable[[str], float | None]:
    value = _of(part, key)
    return lambda method: None if (found := value(method)) is None else 1 - found
