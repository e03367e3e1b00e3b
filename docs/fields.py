"""Update the tables of fields in results.md from `tactflow.message.fields`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tactflow.message.fields import Message, Part, SeparateContact

PAGE = Path(__file__).resolve().parent / "results.md"


def updated(page: str) -> str:
    """The text of the page with its tables as the description has them now."""
    tables = {"message": table(Message, "field"), "fields": "\n".join(part_tables())}
    for name, text in tables.items():
        before, begin, rest = page.partition(f"<!-- {name} -->\n")
        page = before + begin + text + "".join(rest.partition("<!-- end -->")[1:])
    return page


def table(part: type[Part], heading: str) -> str:
    """The keys of a part as a table in Markdown."""
    fields = {field.alias or name: field.description for name, field in part.model_fields.items()}
    rows = [f"| `{name}` | {meaning} |" for name, meaning in fields.items()]
    text = "\n".join([f"| {heading} | meaning |", "| --- | --- |", *rows, ""])
    return text.replace("^2", "²").replace("^3", "³")


def part_tables() -> Iterator[str]:
    """A table for each part of the message, and for each part of those."""
    for key in Message.all_keys():
        # A separate contact has the first fields of `contact`.
        if key.part is None or key.part is SeparateContact:
            continue
        yield table(key.part, f"`{key.name}`")
        for inner in key.part.all_keys():
            if inner.part is not None:
                yield table(inner.part, f"`{key.name}.{inner.name}`")


if __name__ == "__main__":
    PAGE.write_text(updated(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
