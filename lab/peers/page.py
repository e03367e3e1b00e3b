"""The page about the numbers, and its plot. `page.md` has its words; every number comes from peers.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, Final

from lab.peers.depth import NETWORK

Numbers = Mapping[str, Any]
Column = tuple[str, str, str, int]
"""Heading; path in the numbers, with * for the method; format; 1 if more is better, -1 if less is."""
TEMPLATE: Final = Path(__file__).with_name("page.md")

DOTS: Final[Sequence[Column]] = (
    ("named scenes: RMS px", "dots|all|*|displacement_rms", ".3f", -1),
    ("wrong %", "dots|all|*|wrong_percent", ".1f", -1),
    ("lost %", "dots|all|*|lost_percent", ".1f", -1),
    ("random sensors: RMS px", "dots_wide|all|*|displacement_rms", ".2f", -1),
    ("wrong %", "dots_wide|all|*|wrong_percent", ".1f", -1),
    ("lost %", "dots_wide|all|*|lost_percent", ".1f", -1),
    ("real gels: found %", "dots_gels|*|other labs|found", ".1f", 1),
    ("false %", "dots_gels|*|other labs|false", ".1f", -1),
    ("real gels, set for each: found %", "dots_gels|*|same lab|found", ".1f", 1),
    ("false %", "dots_gels|*|same lab|false", ".1f", -1),
    ("ms", "dots|ms|*", ".2f", -1),
    ("MB", "memory|dots|*", ".0f", -1),
    ("lines", "code|dots|*", ".0f", -1),
)
CONTACT: Final[Sequence[Column]] = (
    ("named scenes: IoU", "contact|all|*|contact_iou", ".2f", 1),
    ("false %", "contact|all|*|false_contacts", ".1f", -1),
    ("missed %", "contact|all|*|missed_contacts", ".1f", -1),
    ("random sensors: IoU", "contact_wide|all|*|contact_iou", ".2f", 1),
    ("false %", "contact_wide|all|*|false_contacts", ".1f", -1),
    ("missed %", "contact_wide|all|*|missed_contacts", ".1f", -1),
    ("real gels: hull IoU, median", "contact_gels|*|hull_iou", ".2f", 1),
    ("10 % quantile", "contact_gels|*|worst_tenth", ".2f", 1),
    ("false %", "contact_gels|*|false_contacts", ".1f", -1),
    ("missed %", "contact_gels|*|missed_contacts", ".1f", -1),
    ("ms", "contact|ms|*", ".1f", -1),
    ("MB", "memory|contact|*", ".0f", -1),
    ("lines", "code|contact|*", ".0f", -1),
)
SETS: Final = ("gelslam", "mini_ball", "mini_ball_9mm", "digit_fots", "wedge_ball")
DEPTH: Final[Sequence[Column]] = (
    *(
        (f"{'normals, deg: ' * (not i)}{name}", f"depth|{name}|*|normals", ".1f", -1)
        for i, name in enumerate(SETS)
    ),
    *((f"{'cap, %: ' * (not i)}{name}", f"depth|{name}|*|cap", ".1f", -1) for i, name in enumerate(SETS)),
    ("ms, mini_ball", "depth|mini_ball|*|ms", ".1f", -1),
    ("s to learn", "depth|mini_ball|*|learning_s", ".1f", -1),
)


def write(numbers: Numbers, path: Path) -> None:
    """Write the page, and the plot next to it."""
    plot(numbers, path.with_suffix(".jpg"))
    path.write_text(text(numbers, path.with_suffix(".jpg").name), encoding="utf-8")


def text(numbers: Numbers, picture: str) -> str:
    """The page, Markdown."""
    ours = [name for name in numbers["contact"]["all"] if name.startswith("tactflow")]
    contacts = [*ours, *(name for name in numbers["contact"]["all"] if name not in ours)]
    tables = {
        "dots": list(table(numbers, DOTS, list(numbers["dots"]["all"]))),
        "contact": list(table(numbers, CONTACT, contacts)),
        "depth": list(table(numbers, DEPTH, ["tactflow", NETWORK])),
    }
    others = {
        "machine": [", ".join(f"{key} {value}" for key, value in numbers["machine"].items())],
        "picture": [picture],
        "attempts": attempts(numbers["attempts"]),
    }
    values = Values({name: "\n".join(lines) for name, lines in (tables | others).items()})
    values.numbers = numbers
    return Page(TEMPLATE.read_text(encoding="utf-8")).substitute(values)


class Page(Template):
    """A text with `$name` for a table and `${path of a number:format}`."""

    braceidpattern = r"[^}]+"


class Values(dict[str, str]):
    """Values of the page: tables, and every number by its path; "-" if there is none."""

    numbers: Numbers

    def __missing__(self, key: str) -> str:
        path, _, form = key.partition(":")
        value = at(self.numbers, path)
        return "-" if value is None else format(value, form)


def at(numbers: Numbers, path: str, method: str = "") -> Any:
    """The value at a path, with the method in place of *; None if there is none."""
    value: Any = numbers
    for step in path.split("|"):
        value = value.get(method if step == "*" else step, {})
    return None if value == {} else value


def table(numbers: Numbers, columns: Sequence[Column], methods: Sequence[str]) -> Iterator[str]:
    """Lines of a table with a row for each method, the first of which is the one to beat."""
    yield "| | " + " | ".join(heading for heading, *_ in columns) + " |"
    yield "| --- |" + " --- |" * len(columns)
    for method in methods:
        cells = []
        for _, path, form, sign in columns:
            value, ours = at(numbers, path, method), at(numbers, path, methods[0])
            shown = "-" if value is None else format(value, form)
            is_better = value is not None and sign * (float(shown) - float(format(ours, form))) > 0
            cells.append(f"**{shown}**" if is_better else shown)
        yield f"| {method} | " + " | ".join(cells) + " |"


def attempts(tried: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """Lines of a table of packages that were tried in vain."""
    yield from ("| package | what it says |", "| --- | --- |")
    for attempt in tried:
        yield f"| {attempt['package']} {attempt['version']} | {attempt['error']} |"


def plot(numbers: Numbers, path: Path) -> None:
    """Time against error: dots, contact, normals."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    dots, contact = "dots|ms|*", "contact|ms|*"
    panels: dict[str, dict[str, tuple[str, str]]] = {
        "Dots: RMS error, px": {
            "named scenes": (dots, "dots|all|*|displacement_rms"),
            "random sensors": (dots, "dots_wide|all|*|displacement_rms"),
        },
        "Contact: overlap (more is better)": {
            "named scenes": (contact, "contact|all|*|contact_iou"),
            "random sensors": (contact, "contact_wide|all|*|contact_iou"),
            "real gels (hulls)": (contact, "contact_gels|*|hull_iou"),
        },
        "Normals: error, degrees": {
            name: (f"depth|{name}|*|ms", f"depth|{name}|*|normals") for name in numbers["depth"]
        },
    }
    methods = list(numbers["dots"]["all"]), list(numbers["contact"]["all"]), ["tactflow", NETWORK]
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), constrained_layout=True)
    for axis, (title, kinds), names in zip(axes, panels.items(), methods, strict=True):
        for marker, (kind, (ms, error)) in zip("osD^v", kinds.items(), strict=False):
            axis.plot([], [], marker, color="0.5", label=kind)
            for number, name in enumerate(names):
                if at(numbers, error, name) is not None:
                    label = name if marker == "o" else None
                    axis.plot(
                        at(numbers, ms, name),
                        at(numbers, error, name),
                        marker,
                        color=f"C{number}",
                        label=label,
                    )
        axis.set(title=title, xlabel="ms per picture", xscale="log", xlim=(0.03, 300))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    axes[0].set_yscale("log")
    figure.savefig(path, dpi=90, pil_kwargs={"quality": 85})
    plt.close(figure)
