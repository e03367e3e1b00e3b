"""Plays every case and writes the section "faults" of docs/reliability.md: `make reliability`."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY
from tests.faults.rig import Seen
from tests.faults.table import CASES, SECTIONS, Case

PAGE = REPOSITORY / "docs" / "reliability.md"
BEGIN, END = "<!-- faults -->", "<!-- end of faults -->"

LONGEST = 150
"""Letters of what was said that the page shows."""

INTRODUCTION = """\
Each line is a case in tests/faults/table.py: a test lets it happen and compares what is seen with what is
promised. *Seen* are the exit code, what was said, and what was left behind, when this page was written.
`make test` plays the quick ones, `make soak` the others too, and `make reliability` writes this page.

Exit codes: 0 all went well, 2 the command line or the pipeline file is wrong, 3 a stage or a sink failed,
4 the source failed, 130 a second signal. The system gives -9 to what was killed. Results are never lost
with 0, except those that a live run drops and counts.
"""


def row(case: Case) -> str:
    """How a case begins in the page."""
    return f"| {case.part} | {case.fault} | {case.promise} |"


def shown(seen: Seen, folder: Path) -> str:
    """What was seen, in a cell of a table."""
    said = re.sub(r"\S*/tactflow-disk-[^/\s]*/|" + re.escape(f"{folder}/"), "", seen.said)
    said = said.replace(str(folder), ".")
    said = re.sub(r" \(pipeline\.yaml:[0-9:]*\)|since [0-9:]+ |tactflow: INFO: [^\n]*\n", "", said)
    lines = [line if len(line) <= LONGEST else f"{line[:LONGEST]} ..." for line in said.splitlines()]
    parts = [f"exit {seen.exit}", *(f"“{line.replace('|', ' ')}”" for line in lines), seen.kept]
    return "; ".join(filter(None, parts))


def main() -> int:
    """Play all, write the page; 1 if something is not as promised."""
    text, wrong = INTRODUCTION, 0
    for title, cases in SECTIONS.items():
        text += f"\n### {title}\n\n| | what happens | promised | seen |\n| --- | --- | --- | --- |\n"
        for case in cases:
            with tempfile.TemporaryDirectory() as name:
                try:
                    seen = case.play(Path(name))
                except pytest.skip.Exception as reason:
                    print(f"{case.name}: cannot be played here: {reason}", file=sys.stderr)
                    return 1
                text += f"{row(case)} {shown(seen, Path(name))} |\n"
            differences = case.differences(seen)
            wrong += bool(differences)
            print(case.name, *differences, sep="\n    ", file=sys.stderr)
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    PAGE.write_text(f"{before}{BEGIN}\n\n{text.strip()}\n\n{END}{after}", encoding="utf-8")
    print(f"{len(CASES)} cases, {wrong} not as promised", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
