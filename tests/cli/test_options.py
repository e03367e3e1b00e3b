"""Options that several commands share."""

from __future__ import annotations

import pytest

from tactflow.cli.main import main, make_parser
from tactflow.cli.options import listed_sources


@pytest.mark.parametrize("command", ["start", "detect"])
def test_a_source_may_be_given_with_or_without_the_name_of_the_option(command: str) -> None:
    parser = make_parser(command)
    for words in (["film.avi"], ["--source", "film.avi"], ["--source=film.avi"]):
        assert parser.parse_args([command, *words]).source == "film.avi"
    assert parser.parse_args([command]).source is None


@pytest.mark.parametrize(
    ("command", "name"),
    [(["batch", "--out", "out"], "words"), (["export", "hdf5", "--out", "out"], "recordings")],
)
def test_several_sources_may_be_given_with_or_without_the_name_of_the_option(
    command: list[str], name: str
) -> None:
    parser = make_parser(command[0])
    for words in (["a.avi", "b.avi"], ["a.avi", "--source", "b.avi"], ["--source=a.avi", "--source=b.avi"]):
        assert listed_sources(parser.parse_args([*command, *words]), name) == ["a.avi", "b.avi"]


@pytest.mark.parametrize(
    "command", [["detect"], ["batch", "--out", "out"], ["export", "hdf5", "--out", "out"]]
)
def test_a_command_that_needs_a_source_says_so(
    command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command) == 2
    assert "the following arguments are required: SRC" in capsys.readouterr().err
