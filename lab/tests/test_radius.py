from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.judges.radius import Radii, labelled_radii, main, row


def test_labelled_circles_are_read_from_each_kind_of_file(tmp_path: Path) -> None:
    (tmp_path / "labels.json").write_text('{"001": {"center": [1, 2], "radius": 27}, "002": {"other": 1}}')
    assert labelled_radii(tmp_path, "") == {"001": 27.0}
    (tmp_path / "labels.csv").write_text("file,x,y,radius_px\npress-1.jpg,1,2,23\n")
    assert labelled_radii(tmp_path, "") == {"press-1": 23.0}


def test_outlines_of_the_package_are_circles_where_a_folder_has_none(tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("image,ball_diameter_mm\n6.310mm_0.png,6.31\n")
    radii = labelled_radii(tmp_path, "gels/gelslim_ball")
    assert len(radii) > 10
    assert all(10 < radius < 100 for radius in radii.values())


def test_a_row_has_medians_of_the_presses_in_which_both_radii_are_known() -> None:
    radius, unknown = np.array([20.0, 22.0, 24.0]), np.full(3, np.nan)
    radii = Radii(radius, radius / 2, np.array([20, 20, np.nan]), unknown)
    name, count, area, core, *against_ball = row("gel", radii, None)
    assert (name, count, area[:4], core[:4]) == ("gel", "3", "1.05", "0.53")
    assert against_ball == ["-"] * 5


def test_unknown_sets_and_missing_recordings_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["--data", str(tmp_path), "other"])
    assert "unknown set other" in capsys.readouterr().err
    assert main(["--data", str(tmp_path), "mini_ball"]) == 0
    assert "not in" in capsys.readouterr().err
