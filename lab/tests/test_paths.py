"""What runs for a task is counted."""

from __future__ import annotations

from typing import Any

from lab.paths import HOME, Trace


def defined(files: dict[str, str]) -> dict[str, Any]:
    """Functions of made-up files of the package."""
    names: dict[str, Any] = {}
    for file, text in files.items():
        exec(compile(text, str(HOME / "room" / file), "exec"), names)
    return names


def test_a_function_is_counted_once_with_its_file() -> None:
    names = defined(
        {"a.py": "def double(x): return 2 * x\ndef sums(n): return [double(i) for i in range(n)]"}
    )
    with Trace() as trace:
        names["sums"](3)
    assert trace.functions == {("tactflow/room/a.py", "sums"), ("tactflow/room/a.py", "double")}
    assert trace.back == set()


def test_a_call_of_a_file_that_waits_for_its_result_is_a_step_back() -> None:
    caller = "def outer(): return inner(report)\ndef report(): return 1"
    names = defined({"a.py": caller, "b.py": "def inner(call): return call()"})
    with Trace() as trace:
        names["outer"]()
    assert trace.back == {("tactflow/room/b.py", "tactflow/room/a.py")}


def test_the_next_item_of_a_generator_is_no_step_back() -> None:
    caller = "def outer(): return inner(items())\ndef items(): yield from (1, 2)"
    names = defined({"a.py": caller, "b.py": "def inner(items): return sum(items)"})
    with Trace() as trace:
        assert names["outer"]() == 3
    assert trace.back == set()
