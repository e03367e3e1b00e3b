"""What can take the place of a stage is found by its ports."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.config.registry import resolve
from tactflow.config.replacements import replacements

OWN = """
from typing import NamedTuple

from tactflow import Absent, Contact, Frame, Stage, StageParams
from tactflow.ports import ContactMask, Image, Touching


class Own(Stage):
    memory = "pure"

    def process(self, contact_mask: ContactMask, frame: Frame) -> Contact | Absent:
        return Absent("none")


class NeedsMore(Own):
    def process(self, contact_mask: ContactMask, image: Image) -> Contact | Absent:
        return Absent("none")


class NeedsSettings(Own):
    class Params(StageParams):
        model: str


class GivesMore(Own):
    class Both(NamedTuple):
        contact: Contact
        touching: Touching

    def process(self, contact_mask: ContactMask) -> Both:
        raise NotImplementedError


class _Private(Own):
    pass


class Wrong(Stage):
    def process(self, contact_mask: ContactMask) -> Contact:
        raise NotImplementedError
"""


@pytest.mark.parametrize(
    ("stage", "others"),
    [
        ("tracker", ["classic_tracker", "dis_flow", "lucas_kanade", "nearest_dots", "rlof"]),
        ("marker_mask", ["adaptive_threshold", "blob_detector", "classic_mask", "top_hat"]),
        ("inpaint", ["frequency_selective"]),
        ("difference", ["classic_difference", "knn", "mog2", "otsu", "ssim"]),
        ("hull", ["classic_hull", "fit_line", "min_area_rect"]),
        ("flow_in_mask", ["classic_flow"]),
        ("otsu", ["classic_difference", "difference", "knn", "mog2", "ssim"]),
        # `fusion` takes the contact mask that it gives; `normals` gives something else than `depth`.
        ("fusion", []),
        ("depth", ["frankot_chellappa"]),
        ("capture", []),
    ],
)
def test_registered_stages_with_the_same_ports_replace_each_other(stage: str, others: list[str]) -> None:
    assert [found.name for found in replacements(resolve(stage, "stages"))] == others


def test_the_files_of_a_pipeline_are_searched_too(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    used = resolve("./own.py:NeedsMore", "stages", tmp_path)
    found = [other.name for other in replacements(resolve("hull", "stages"), [used])]
    assert found == ["./own.py:Own", "classic_hull", "fit_line", "min_area_rect"]
