"""Pictures in a column of a Parquet file, as Hugging Face's datasets have them."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.engine.errors import SourceError
from tactflow.sources import open_source, recording_suffixes

pa = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
pq = pytest.importorskip("pyarrow.parquet")

IMAGES = np.random.default_rng(1).integers(0, 256, (40, 12, 16, 3), np.uint8)
FILES = [cv2.imencode(".png", image)[1].tobytes() for image in IMAGES]
WITH_PATHS = [{"bytes": file, "path": f"{index}.png"} for index, file in enumerate(FILES)]


def write(path: Path, **columns: Any) -> Path:
    path.parent.mkdir(exist_ok=True)
    pq.write_table(pa.table(columns), path, row_group_size=25)
    return path


def played(spec: str, fps: float | None = None) -> list[tuple[Any, float]]:
    reader = open_source(spec, fps=fps)
    try:
        return list(iter(reader.read, None))
    finally:
        reader.close()


COLUMNS = {
    "bytes": pa.array(FILES),
    "many bytes": pa.array(FILES, pa.large_binary()),
    "bytes and path": pa.array(WITH_PATHS),
}


@pytest.mark.parametrize("kind", COLUMNS)
def test_a_column_of_pictures_gives_its_frames(kind: str, tmp_path: Path) -> None:
    path = write(tmp_path / "press.parquet", image=COLUMNS[kind], label=list(range(40)))
    reader = open_source(str(path))
    assert (reader.total, reader.size, reader.live) == (40, (16, 12), False)
    reader.close()
    reader.close()
    assert reader.read() is None
    for spec in (str(path), f"{path}?column=image"):
        found = played(spec, fps=20)
        assert np.array_equal([image for image, _ in found], IMAGES)
        assert [t for _, t in found] == [index / 20 for index in range(40)]


def test_a_folder_of_this_kind_is_read_file_by_file(tmp_path: Path) -> None:
    folder = tmp_path / "press.parquet"
    for number, rows in ((10, slice(25, 40)), (9, slice(0, 25))):
        write(folder / f"part-{number}.parquet", image=FILES[rows])
    assert np.array_equal([image for image, _ in played(str(folder))], IMAGES)


FILE = pa.struct({"bytes": pa.binary(), "path": pa.string()})
WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "two columns": (
        {"left": FILES, "right": WITH_PATHS, "t": [0.0] * 40},
        "",
        r"add \?column= one of: left, right; the columns are left \(binary\), .*t \(double\)",
    ),
    "no such column": ({"a": FILES}, "?column=b", "b is no column with pictures; required one of: a;"),
    "numbers": ({"t": [1.0, 2.0]}, "", r"no column holds pictures .*; there are t \(double\)"),
    "no picture": ({"a": [b"hello"]}, "", "press.parquet, a, row 0: not an image"),
    "nothing": ({"a": [None]}, "?column=a", "no column holds pictures"),
    "a missing picture": ({"a": pa.array([None], pa.binary())}, "", "row 0: there is no picture in this row"),
    "in another file": (
        {
            "a": pa.array(
                [{"bytes": None, "path": "/etc/passwd"}], pa.struct({"bytes": "binary", "path": "str"})
            )
        },
        "",
        "row 0: .*it is in another file, /etc/passwd, which is not read",
    ),
    "no rows": ({"a": pa.array([], pa.binary())}, "", "there is no picture in it"),
    "a setting of others": ({"a": FILES}, "?dataset=a", "required column=name of a column with pictures"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_holds_no_pictures_is_refused(wrong: str, tmp_path: Path) -> None:
    columns, query, says = WRONG[wrong]
    path = write(tmp_path / "press.parquet", **columns)
    with pytest.raises(SourceError, match=says):
        open_source(f"{path}{query}")


def test_a_file_that_is_cut_off_or_a_package_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "press.parquet", image=FILES)
    (tmp_path / "empty.parquet").mkdir()
    with pytest.raises(SourceError, match=r"there is no \.parquet file in this folder"):
        open_source(str(tmp_path / "empty.parquet"))
    os.truncate(path, path.stat().st_size // 2)
    with pytest.raises(SourceError, match="is damaged or cut off"):
        open_source(str(path))
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(SourceError, match=r"Parquet files need pyarrow: pip install 'tactflow\[parquet\]'"):
        open_source(str(path))


def test_tables_of_results_in_a_folder_are_not_taken_for_recordings() -> None:
    assert ".parquet" not in recording_suffixes()
    assert ".zarr.zip" in recording_suffixes()
