"""The force by known weights: which loads are found, what is said, and how honest the error is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tactflow.calibration.force_samples import Moment, Watched
from tactflow.calibration.weights import (
    GRAVITY,
    LoadFinder,
    WeightGuide,
    fit_loads,
    read_weights,
)
from tactflow.calibration.words import force_words
from tactflow.engine.errors import ConfigError
from tactflow.vision.force import Seen

FPS = 10


def found(levels: list[float]) -> LoadFinder:
    """The loads in what the gel shows, ten times a second; 0 where nothing touches."""
    finder = LoadFinder()
    for number, level in enumerate(levels):
        finder.add(level > 0, Moment(number, number / FPS, level))
    return finder


def session(seed: int, forces: np.ndarray, scatter: float = 0.1) -> tuple[Watched, list[tuple[int, int]]]:
    """Frames of a gel without dots under loads, 10 each, between 10 at rest, and where the loads are.

    scatter : relative, from load to load.
    """
    rng = np.random.default_rng(seed)
    change = np.zeros(10 + 20 * len(forces))
    loads = [(10 + 20 * number, 19 + 20 * number) for number in range(len(forces))]
    for (first, last), force in zip(loads, forces, strict=True):
        change[first : last + 1] = 4 * force * (1 + scatter * rng.normal())
    touched = change > 0
    change += 0.5 + 0.05 * rng.normal(size=len(change))
    numbers = np.arange(len(change), dtype=float)
    unknown = dict.fromkeys(("shear_by_area", "shear_by_width"), np.full(len(change), np.nan + 0j))
    seen = Watched(numbers, numbers / FPS, {"root_change": touched * change}, unknown, touched, change, 0.5)
    return seen, loads


def test_a_load_counts_once_as_soon_as_it_lies_still() -> None:
    growing = [float(level) for level in range(1, 11)]
    off = [0.0] * 5
    finder = found([0, 0, *growing, *[10.0] * 30, *off, *[5.0] * 15])
    assert finder.loads == [(15, 19), (52, 56)]
    assert finder.lasts
    # A light load that is missed in single frames is still the same one.
    assert found([0, *[1.0] * 15, 0, *[1.0] * 15, 0, *[1.0] * 15, *off]).loads == [(6, 10)]
    # A load that is never still, and one that is lifted too soon.
    assert found([0, *[1.0, 1.5, 2.2, 3.3, 5, 7, 10, 15, 22, 33, 50, 70], 0]).loads == []
    assert found([0, *[5.0] * 8, *off, *[5.0] * 8]).loads == []
    # Noise of single frames does not count as motion.
    noisy = 5 + np.random.default_rng(1).normal(0, 0.3, 30)
    assert len(found([0, *noisy.tolist()]).loads) == 1


def test_weights_are_grams_or_the_column_of_a_csv(tmp_path: Path) -> None:
    assert read_weights(["200", "1e3"]) == [200 * GRAVITY, 1000 * GRAVITY]
    path = tmp_path / "loads.csv"
    path.write_text("name, kg\nsmall, 0.2\nlarge, 1\n")
    assert read_weights([str(path)]) == pytest.approx([200 * GRAVITY, 1000 * GRAVITY])
    path.write_text("fz\n2.5\n\n4\n")
    assert read_weights([str(path)]) == [2.5, 4.0]
    for text, words in (
        ("weight\n3\n", "must name a column g, fz, kg"),
        ("g\n100\n\n-3\n", "line 4: required a number"),
        ("g\n", "required one line for each load, found none"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=words):
            read_weights([str(path)])
    with pytest.raises(ConfigError, match="got 'heavy'"):
        read_weights(["100", "heavy"])


def test_stated_errors_by_six_weights_hold_for_loads_left_out() -> None:
    forces = np.array([1.0, 2, 5, 8, 12, 16])
    within, shares = [], []
    for seed in range(40):
        seen, loads = session(seed, forces)
        model = fit_loads(seen, loads, forces.tolist()).entry.model()
        rng = np.random.default_rng(1000 + seed)
        for force in rng.uniform(1, 16, 20):
            change = 4 * force * (1 + 0.1 * rng.normal())
            said = model.force(Seen({"root_change": change}, {}))
            assert said.stderr[2] is not None
            within.append(abs(said.value[2] - force) / said.stderr[2])
            shares.append((said.value[2] - force) / forces.max())
    assert np.sqrt(np.mean(np.square(shares))) < 0.1
    assert 0.6 < np.mean(np.array(within) < 1) < 0.78
    assert 0.9 < np.mean(np.array(within) < 2) < 0.99


def test_a_force_that_the_gel_does_not_follow_is_told() -> None:
    forces = np.array([1.0, 2, 5, 8, 12, 16])
    seen, loads = session(1, forces)
    for given, is_told in ((forces, False), (forces[[3, 0, 5, 1, 4, 2]], True)):
        words = " ".join(force_words(fit_loads(seen, loads, given.tolist()), {}))
        assert ("do not rely on it" in words) == is_told


def test_a_reading_that_is_missing_leaves_its_load_out() -> None:
    forces = [1.0, math.nan, 5.0, 8.0]
    seen, loads = session(1, np.array([1.0, 3, 5, 8]), scatter=0.02)
    entry = fit_loads(seen, loads, forces).entry
    assert entry.presses == 3
    assert entry.left_out == "load"
    assert entry.press is not None
    assert entry.press.stiffness["root_change"] == pytest.approx(0.25, rel=0.05)
    with pytest.raises(ConfigError, match="required 3 loads or more, found 2"):
        fit_loads(seen, loads, [1.0, math.nan, math.nan, 8.0])


def test_the_guide_names_the_next_weight_and_the_end_of_a_recording_is_checked() -> None:
    lines: list[str] = []
    guide = WeightGuide([200 * GRAVITY, 500 * GRAVITY], lines.append)
    assert lines == ["Put 200 g on the gel, and let go."]
    assert guide.state["now"] == lines[0]
    assert guide.state["wanted"] == 2
    guide.live = False
    with pytest.raises(ConfigError, match=r"got 2 weights, and found 0 loads .*\(none\)"):
        guide.finish(lambda _: math.nan)
