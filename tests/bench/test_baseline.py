from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.bench.compare import against
from tactflow.bench.run import Plan, run_bench
from tactflow.cli.bench import packaged_files

BASELINE = Path(__file__).with_name("baseline_quick.json")


@pytest.mark.timeout(300)
def test_no_error_of_the_quick_bench_got_worse_than_the_stored_one() -> None:
    """After a change that is meant to move errors, store them anew: `bench --quick --write-baseline FILE`."""
    result = run_bench(Plan(packaged_files(), quick=True, memory=False))
    assert [m.failure for m in result.measurements if m.failure] == []
    assert [str(regression) for regression in against(result, BASELINE)] == []
