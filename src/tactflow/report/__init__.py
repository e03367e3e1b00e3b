"""Reports of a command: sections of text and tables, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """columns : headings with units, such as "time, ms". rows : of cells."""

    columns: Sequence[str]
    rows: Sequence[Sequence[object]]


@dataclass(frozen=True)
class Section:
    """A heading followed by text and tables."""

    title: str
    text: str = ""
    tables: Sequence[Table] = ()


def markdown(sections: Iterable[Section]) -> Iterator[str]:
    """Lines of the text and tables of sections in Markdown, with aligned columns.

    >>> speed = Table(["method", "time, ms"], [["fast", 1.25], ["exact", 31]])
    >>> print(*markdown([Section("Times", tables=[speed])]), sep="\\n")
    ### Times
    <BLANKLINE>
    | method | time, ms |
    | ------ | -------- |
    | fast   | 1.25     |
    | exact  | 31       |
    <BLANKLINE>
    """
    for section in sections:
        yield from (f"### {section.title}", "", *([*section.text.splitlines(), ""] if section.text else []))
        for table in section.tables:
            lines = [table.columns, *table.rows]
            cells = [[str(cell).replace("|", "\\|").replace("\n", " ") for cell in line] for line in lines]
            widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
            cells.insert(1, ["-" * width for width in widths])
            for line in cells:
                yield f"| {' | '.join(map(str.ljust, line, widths))} |"
            yield ""
