"""Whatever goes wrong around a run, what is promised holds."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.faults.__main__ import END, PAGE, row
from tests.faults.table import CASES, Case


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, id=case.name, marks=[pytest.mark.slow] if case.slow else []) for case in CASES],
)
def test_what_is_promised_is_seen(case: Case, tmp_path: Path) -> None:
    assert case.differences(case.play(tmp_path)) == []


def test_the_page_has_every_case_and_no_other() -> None:
    """`make reliability` writes it."""
    page, _, _ = PAGE.read_text().partition(END)
    assert [case.name for case in CASES if row(case) not in page] == []
    sections = page.count("\n### ")
    assert page.count("\n| ") == len(CASES) + 2 * sections
