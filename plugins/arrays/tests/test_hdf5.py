"""`tactflow export hdf5`: plain arrays that are what the pipeline found, and that play again."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import tactflow
from tactflow.cli.main import main
from tactflow.engine.errors import StageError
from tactflow.engine.frame import Frame
from tactflow.message.result import Result
from tactflow.plugins.arrays import export as hdf5
from tactflow.vision.types import Markers
from tests.faults.rig import fill, small_disk

h5py = pytest.importorskip("h5py", reason="the extra hdf5 is not installed")

SPECS = ["sim:press?frames=100", "sim:twist?frames=20"]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Result]]:
    """Two recordings, and what the pipeline finds in the first one."""
    out = tmp_path_factory.mktemp("export") / "out"
    with redirect_stderr(StringIO()) as errors:
        assert main(["export", "hdf5", *SPECS, "--out", str(out)]) == 0
    assert errors.getvalue().endswith(f"{out}: 2 episodes\n")
    return out, list(tactflow.stream(source=SPECS[0], settings={"sinks": {}}, images=True))


def test_the_arrays_are_what_was_found(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    file = h5py.File(out / "episode_000.h5", "r")
    assert np.array_equal(file["frames"][:], [r.frame.image for r in results])
    assert list(file["t"][:]) == [r.t for r in results]
    assert list(file["seq"][:]) == list(range(100))
    assert list(file["reference"][:]) == [r.frame.reference for r in results]
    touched = np.array([r.contact is not None for r in results])
    assert 20 < touched.sum() < 80
    assert np.array_equal(np.isfinite(file["contact_area"][:]), touched)
    assert np.array_equal(file["flow_count"][:] >= 0, touched)
    for index, result in enumerate(results):
        assert result.markers is not None
        assert np.array_equal(file["markers_position"][index], result.markers.position)
        assert np.array_equal(file["markers_origin"][index], result.markers.origin)
        assert np.array_equal(file["markers_status"][index], result.markers.status)
        hull = file["contact_hull"][index]
        found = np.empty((0, 2)) if result.contact is None else result.contact.hull
        assert np.array_equal(hull[np.isfinite(hull[:, 0])], found)
        if result.contact is not None and result.flow is not None:
            assert file["contact_area"][index] == result.contact.area
            assert file["flow_count"][index] == result.flow.count


def test_its_attributes_say_what_is_in_it(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    file = h5py.File(out / "episode_001.h5", "r")
    assert file.attrs["recording"] == SPECS[1]
    assert (file.attrs["sensor"], file.attrs["schema"]) == ("main", "tactflow.frame/1")
    mapping = results[0].value("mapping")
    assert np.array_equal(file.attrs["raw_to_processed"], mapping.matrix)
    assert file["markers_status"].attrs["description"] == "(N, M): 0 tracked, 1 inferred, 2 lost"
    assert file["flow_count"].fillvalue == -1


def test_it_plays_again_with_the_same_results(exported: tuple[Path, list[Result]]) -> None:
    out, results = exported
    source = str(out / "episode_000.h5")
    again = list(tactflow.stream(source=source, settings={"sinks": {}}, images=True))
    assert len(again) == len(results)
    for one, other in zip(again, results, strict=True):
        assert np.array_equal(one.frame.image, other.frame.image)
        assert one.to_json(detail=True) == other.to_json(detail=True)


def black(count: int, markers: int = 0) -> list[Result]:
    """Frames of black pictures with so many markers; none where 0."""
    image = np.zeros((8, 6, 3), np.uint8)
    points = np.arange(2.0 * markers).reshape(-1, 2)
    found = Markers(points, points, np.zeros(markers, np.uint8), np.zeros(markers)) if markers else None
    return [Result(Frame("main", seq, seq / 10, image), {"markers": found}) for seq in range(count)]


def test_what_is_missing_differs_from_every_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Several chunks, the last of which is not full.
    monkeypatch.setattr(hdf5, "CHUNK_FRAMES", 4)
    hdf5.export(tmp_path / "out", [("black", [*black(5), *black(3, 2), *black(5, 3)])])
    found = h5py.File(tmp_path / "out" / "episode_000.h5", "r")
    assert found["frames"].shape[0] == 13
    assert found["t"].chunks[0] == 4
    assert found["markers_position"].shape == (13, 3, 2)
    assert np.isfinite(found["markers_position"][:, :, 0]).sum(1).tolist() == [0] * 5 + [2] * 3 + [3] * 5
    assert found["markers_status"][6].tolist() == [0, 0, 255]
    assert np.isnan(found["contact_area"][:]).all()
    assert found["force_in_range"][:].tolist() == [-1] * 13


def test_a_recording_without_a_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="there is no frame in it"):
        hdf5.export(tmp_path / "out", [("none", [])])


@pytest.mark.skipif(sys.platform != "linux", reason="mounts a small disk")
@pytest.mark.parametrize("free", [0, 4 << 20])
def test_a_full_disk_is_told_and_leaves_nothing(free: int, tmp_path: Path) -> None:
    # In a process of its own: HDF5 can crash it as it ends.
    with small_disk() as disk:
        (disk / "spare").write_bytes(bytes(free))
        fill(disk)
        (disk / "spare").unlink()
        command = [sys.executable, "-m", "tactflow", "export", "hdf5", "sim:press?frames=30"]
        done = subprocess.run(
            [*command, "--out", str(disk / "out")],
            capture_output=True,
            text=True,
            check=False,
            env=os.environ | {"TMPDIR": str(tmp_path)},
        )
        assert (done.returncode, done.stdout) == (3, ""), done.stderr
        assert f"{disk / 'out'}: cannot be written" in done.stderr
        assert "No space left on device" in done.stderr
        assert [path.name for path in disk.iterdir()] == ["filler"]
