"""Damaged input to every parser, a little of it; and well-formed input with any values."""

from __future__ import annotations

import copy
import json
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactflow.cli import listen
from tactflow.config.load import load_pipeline
from tactflow.engine.errors import ConfigError, SourceError
from tactflow.message.result import Result
from tactflow.sources import open_source
from tests.conftest import REPOSITORY
from tests.fuzz.targets import message

INPUTS = 40
"""Of each parser. Enough to run through each; finding something new takes `make fuzz`. Chosen by hand."""


def fuzz(folder: Path, *options: str) -> str:
    """In a process of its own, as what is wrong may end it; what it says at the end."""
    command = [sys.executable, "-m", "tests.fuzz", "--folder", str(folder), *options]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def test_damaged_input_is_refused_and_never_crashes_hangs_or_fills_the_memory(tmp_path: Path) -> None:
    said = fuzz(tmp_path, "--inputs", str(INPUTS))
    assert re.fullmatch(r"\d{3,} inputs, \d{3,} refused, 0 findings .*\n", said)


@pytest.mark.slow
def test_much_damaged_input_is_refused_too(tmp_path: Path) -> None:
    assert ", 0 findings " in fuzz(tmp_path, "--seconds", "15", "--seed", "7")


few = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
scalars = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | st.text()
)
values = st.recursive(
    scalars, lambda part: st.lists(part, max_size=3) | st.dictionaries(st.text(), part, max_size=3)
)
PIPELINE = yaml.safe_load((REPOSITORY / "pipeline.yaml").read_text(encoding="utf-8"))


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The path to everything in a document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [
        *([path] if path else []),
        *(found for key, part in inner for found in places(part, (*path, key))),
    ]


def replaced(document: Any, path: tuple[Any, ...], value: Any) -> Any:
    """A copy with another value at one place."""
    changed = copy.deepcopy(document)
    part = changed
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    return changed


@few
@given(path=st.sampled_from(places(PIPELINE)), value=values)
def test_a_pipeline_with_any_value_anywhere_is_read_or_refused(
    tmp_path: Path, path: tuple[Any, ...], value: Any
) -> None:
    file = tmp_path / "pipeline.yaml"
    file.write_text(json.dumps(replaced(PIPELINE, path, value)), encoding="utf-8")
    with suppress(ConfigError):
        assert load_pipeline(file).nodes


@few
@given(path=st.sampled_from(places(json.loads(message()))), value=values)
def test_a_result_message_with_any_value_anywhere_is_shown_or_passed_over(
    path: tuple[Any, ...], value: Any
) -> None:
    changed = json.dumps(replaced(json.loads(message()), path, value))
    try:
        result = Result.from_message(changed)
    except ValueError:
        return
    assert listen.describe(result)


@few
@given(options=st.text(st.characters(codec="utf-8"), max_size=20))
@pytest.mark.parametrize("source", ["sim:press?", "sim:", "press.mcap?", "*.png?", "[", "**/"])
def test_a_source_with_any_options_is_opened_or_refused(tmp_path: Path, source: str, options: str) -> None:
    spec = source + options if source.startswith("sim:") else f"{tmp_path}/{source}{options.replace('/', '')}"
    with suppress(SourceError):
        open_source(spec).close()
