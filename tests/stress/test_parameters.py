"""A pipeline file with a number that is not finite is refused with words."""

from __future__ import annotations

import types
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import pytest
from pydantic import BaseModel

from tactflow.config.load import load_pipeline
from tactflow.config.registry import names, resolve
from tactflow.engine.errors import ConfigError

REPOSITORY = Path(__file__).resolve().parents[2]


def numbers_of(params: type[BaseModel], path: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    """The paths of all parameters that take a float, those of nested mappings included."""
    found = []
    for name, field in params.model_fields.items():
        here = (*path, field.alias or name)
        for annotation in _alternatives(field.annotation):
            if annotation is float:
                found.append(here)
            elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
                found += numbers_of(annotation, here)
    return found


def _alternatives(annotation: Any) -> list[Any]:
    if get_origin(annotation) in (Union, types.UnionType):
        return [inner for part in get_args(annotation) for inner in _alternatives(part)]
    if get_origin(annotation) not in (None, Literal, list, dict, tuple) and get_args(annotation):
        return _alternatives(get_args(annotation)[0])
    return [annotation]


COMPONENTS = [(section, name) for section in ("stages", "sinks") for name in names(section)]
NUMBERS = [
    pytest.param(section, name, path, id=f"{name}.{'.'.join(path)}")
    for section, name in COMPONENTS
    for path in numbers_of(resolve(name, section, REPOSITORY).params)
]


@pytest.mark.parametrize(("section", "name", "path"), NUMBERS)
def test_a_pipeline_file_refuses_nan_and_infinity_with_their_place(
    section: str, name: str, path: tuple[str, ...]
) -> None:
    for value in (".nan", ".inf", "-.inf"):
        overrides = [f"{section}.{name}.use={name}", f"{section}.{name}.{'.'.join(path)}={value}"]
        with pytest.raises(ConfigError, match=path[-1]):
            load_pipeline(REPOSITORY / "pipeline.yaml", overrides)


def test_the_table_of_numbers_is_not_empty() -> None:
    found = {parameter.id for parameter in NUMBERS}
    assert {"hull.min_area", "tracker.dot", "difference.certainty", "probe.false_alarms"} <= found
