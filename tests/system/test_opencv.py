"""Packages of OpenCV that overwrite each other are named, with what makes them agree."""

from __future__ import annotations

from pathlib import Path

import pytest

from tactflow.system.opencv import opencv_conflict

CONTRIB, PLAIN = "opencv_contrib_python_headless", "opencv_python_headless"


@pytest.mark.parametrize(
    ("folders", "has_contrib", "conflict"),
    [
        ([f"{CONTRIB}-5.0.0.93"], True, None),
        ([f"{PLAIN}-4.11.0.86"], False, None),
        ([f"{CONTRIB}-4.11.0.86", f"{PLAIN}-4.11.0.86"], True, None),
        (["opencv-5.0.0"], True, None),
        ([f"{CONTRIB}-4.11.0.86", f"{PLAIN}-4.11.0.86"], False, "4.11.0.86"),
        ([f"{CONTRIB}-5.0.0.93", f"{PLAIN}-4.11.0.86"], True, "4.11.0.86"),
        ([f"{CONTRIB}-5.0.0.93", "opencv_python-4.10.0.84"], False, "4.10.0.84"),
    ],
)
def test_packages_of_opencv_that_differ_are_reported(
    folders: list[str], has_contrib: bool, conflict: str | None, tmp_path: Path
) -> None:
    for name in (*folders, "numpy-2.4.6"):
        (tmp_path / f"{name}.dist-info").mkdir()
    message = opencv_conflict(tmp_path, has_contrib=has_contrib)
    if conflict is None:
        assert message is None
    else:
        assert message is not None
        assert message.startswith("2 packages of OpenCV have overwritten each other: opencv-contrib-python-")
        assert message.endswith(
            f"pip install --force-reinstall --no-deps opencv-contrib-python-headless=={conflict}"
        )
