"""The force by the displacement of dots: fitted to some loads, tried on others."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactflow.calibration.field_force import fit_field
from tactflow.calibration.file import Calibration, ForceEntry, LinearForceEntry
from tactflow.calibration.force import fit_force, try_force
from tactflow.calibration.force_samples import Watched
from tactflow.calibration.reference import Reference, read_reference
from tactflow.engine.errors import ConfigError
from tactflow.vision.force import Seen
from tests.calibrations import bare_calibration

CELLS = 12
SCATTER = 0.05
"""Standard deviation, mm, with which the gel answers the same load otherwise."""
LIGHT = ForceEntry(
    press=LinearForceEntry(
        stiffness={"root_change": 0.5},
        greatest={"root_change": 40.0},
        error=(0.1, 0.0),
        range=(0.0, 20.0),
        rmse=0.1,
        r2=0.9,
    ),
    change_at_rest=0.0,
    recordings={},
    presses=4,
    left_out="press",
)
"""A force by the light of contacts."""


def pattern() -> np.ndarray:
    """(3, S, 2): displacement of the gel, mm per N, by each component of the force."""
    place = np.stack(np.meshgrid(np.linspace(-1, 1, 4), np.linspace(-1, 1, 3)), axis=-1).reshape(-1, 2)
    drag = np.exp(-np.square(place).sum(axis=1))[:, None]
    return np.stack([drag * (0.3, 0.0), drag * (0.0, 0.2), 0.04 * place])


def pictures(seed: int, loads: int, each: int = 4, scatter: float = SCATTER) -> tuple[np.ndarray, np.ndarray]:
    """Displacement (n, S, 2), mm, and force (n, 3), N, of pictures of some loads, and four at rest."""
    rng = np.random.default_rng(seed)
    force = np.column_stack([rng.uniform(-3, 3, (loads, 2)), rng.uniform(2, 20, loads)])
    field = np.einsum("nf,fsd->nsd", force, pattern()) + scatter * rng.normal(size=(loads, CELLS, 2))
    field, force = (np.concatenate([0 * part[:1], part]).repeat(each, axis=0) for part in (field, force))
    return field + 0.002 * rng.normal(size=field.shape), force


def watched(field: np.ndarray, taken_singly: bool = True) -> Watched:
    """What is seen of frames with dots and without a contact."""
    count = len(field)
    numbers = np.arange(count, dtype=float)
    return Watched(
        numbers,
        numbers / 30,
        {"root_change": np.zeros(count)},
        {name: np.full(count, np.nan + 0j) for name in ("shear_by_area", "shear_by_width")},
        np.zeros(count, bool),
        np.zeros(count),
        0.0,
        field,
        taken_singly,
    )


def fitted(seed: int, loads: int, turn: complex = 1) -> tuple[Watched, Reference]:
    """Frames and forces of loads; turn : of the axes of the gauge."""
    field, force = pictures(seed, loads)
    sideways = (force[:, 0] + 1j * force[:, 1]) * turn
    force = np.column_stack([sideways.real, sideways.imag, force[:, 2]])
    seen = watched(field)
    return seen, Reference("loads.csv", seen.frames, True, force)


def test_stated_errors_of_loads_that_the_fit_has_not_seen_are_honest() -> None:
    within = []
    for seed in range(3):
        seen, known = fitted(seed, 20)
        fit = fit_force({"loads": seen}, {"loads": known})
        assert fit.entry.press is None
        assert fit.entry.left_out == "load"
        assert fit.entry.presses == 20
        model = fit.entry.model(fit.field)
        field, force = pictures(100 + seed, 60, each=1)
        said = [model.force(Seen({}, {}), one) for one in field[1:]]
        error = np.abs(np.array([one.value for one in said], float) - force[1:])
        assert np.sqrt(np.mean(error**2, axis=0)) == pytest.approx([0.25, 0.25, 0.6], rel=0.8)
        within.append([np.mean(error < k * np.array([one.stderr for one in said], float)) for k in (1, 2)])
    one, two = np.mean(within, axis=0)
    assert 0.6 < one < 0.8
    assert 0.9 < two < 0.99


def test_components_that_were_not_measured_stay_unknown() -> None:
    field, force = pictures(1, 12)
    force[:, :2] = np.nan
    fit = fit_force(
        {"a": watched(field)}, {"a": Reference("a.csv", np.arange(len(field)) * 1.0, True, force)}
    )
    assert set(fit.entry.dots) == {"z"}
    found = fit.entry.model(fit.field).force(Seen({}, {}), field[10])
    assert found.value[:2] == found.stderr[:2] == (None, None)
    assert found.value[2] == pytest.approx(force[10, 2], abs=3)


def test_each_group_is_predicted_by_the_others_alone() -> None:
    field, force = pictures(3, 8)
    groups = np.repeat(np.arange(9), 4)
    fit = fit_field(field, force, groups)
    held = groups == 5
    others = fit_field(field[~held], force[~held], groups[~held]).model
    expected = np.array([others(one) for one in field[held]])
    assert fit.predicted[held] == pytest.approx(expected, abs=0.05)


def test_a_gauge_that_is_nearly_parallel_counts_as_parallel_and_a_turned_one_does_not() -> None:
    for turn, angle in ((np.exp(0.02j), 0), (np.exp(1j * (np.pi / 2 + 0.02)), 90), (np.exp(0.6j), 34)):
        seen, known = fitted(2, 20, turn)
        found = fit_force({"a": seen}, {"a": known}).turned
        assert found == pytest.approx(angle, abs=1e-6 if angle in {0, 90} else 8)


def test_the_force_by_dots_survives_the_calibration_file(tmp_path: Path) -> None:
    seen, known = fitted(1, 12)
    fit = fit_force({"a": seen}, {"a": known})
    made = bare_calibration(force=fit.entry, field_force=fit.field)
    made.save(tmp_path / "a.yaml")
    loaded = Calibration.load(tmp_path / "a.yaml")
    assert seen.field is not None
    assert loaded.force is not None
    before, after = fit.entry.model(fit.field), loaded.force.model(loaded.field_force)
    assert after.force(Seen({}, {}), seen.field[9]) == before.force(Seen({}, {}), seen.field[9])
    made.model_copy(update={"field_force": None}).save(tmp_path / "b.yaml")
    with pytest.raises(ConfigError, match=r"its \.npz is of another file"):
        Calibration.load(tmp_path / "b.yaml")


def test_a_csv_may_name_pictures_instead_of_frames(tmp_path: Path) -> None:
    for number in range(12):
        (tmp_path / f"{number}.png").touch()
    lines = ["file,fz", *(f"{number}.png,{number}" for number in range(12))]
    (tmp_path / "loads.csv").write_text("\n".join(lines))
    found = read_reference(tmp_path / "loads.csv", str(tmp_path))
    assert found.by_frame
    assert found.time.tolist() == list(range(12))
    assert found.force[11, 2] == 11
    (tmp_path / "loads.csv").write_text("\n".join([*lines, "12.png,4"]))
    with pytest.raises(ConfigError, match=r"line 14: file: .* has no picture '12\.png'"):
        read_reference(tmp_path / "loads.csv", str(tmp_path))
    (tmp_path / "loads.csv").write_text("\n".join([*lines, "", "12.png,4"]))
    with pytest.raises(ConfigError, match=r"line 15: file: .* has no picture '12\.png'"):
        read_reference(tmp_path / "loads.csv", str(tmp_path))
    with pytest.raises(ConfigError, match="the source has no picture"):
        read_reference(tmp_path / "loads.csv")


def test_pictures_cannot_be_told_by_times() -> None:
    seen, known = fitted(1, 12)
    with pytest.raises(ConfigError, match=r"have no times; name them in loads\.csv in a column file"):
        fit_force({"a": seen}, {"a": replace(known, by_frame=False)})


def test_dots_that_are_never_seen_under_a_load_do_not_count() -> None:
    seen, known = fitted(1, 12)
    assert seen.field is not None
    pressed = known.force[:, 2] > 0
    hidden = replace(
        seen,
        field=np.where(pressed[:, None, None], np.nan, seen.field),
        touched=pressed,
        press={"root_change": 2 * known.force[:, 2]},
    )
    fit = fit_force(dict.fromkeys("abc", hidden), dict.fromkeys("abc", known))
    assert fit.entry.dots == {}
    assert fit.field is None
    assert fit.entry.press is not None


def test_a_force_is_not_compared_where_nothing_presses() -> None:
    seen, known = fitted(1, 12)
    by_dots, by_light = fit_force({"a": seen}, {"a": known}), LIGHT
    idle = replace(known, force=0 * known.force)
    for entry, field, reference in (
        (by_dots.entry, by_dots.field, idle),
        (by_light, None, known),
        (by_dots.entry, by_dots.field, replace(known, time=known.time + 1000)),
    ):
        with pytest.raises(ConfigError, match="a: no frame has both a press and a force"):
            try_force(entry, "a", seen, reference, field)
