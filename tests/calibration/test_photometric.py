"""Which colour is which slope: learned from presses of a ball, tried on other contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tactflow.calibration.photometric import Photometry, fit_photometry
from tactflow.calibration.presses import Session
from tactflow.calibration.samples import press_errors, summary
from tactflow.engine.errors import ConfigError
from tactflow.sim import open_scene
from tactflow.vision.depth.surface import Rest, Surface
from tactflow.vision.geometry import Preprocessor
from tests.calibration.ball_presses import BALL, RAW_MM, deepest, noisy, scale, session_of

PREPROCESS = Preprocessor((800, 600), rotate=90, downsample=2)
SCALE = scale()
ASIDE = 2
"""How far to the side outlines are drawn, px: those of a real gel lie towards its lights."""


@pytest.fixture(scope="module")
def session() -> Session:
    """Presses of a ball, as a calibration has them."""
    right = session_of(open_scene("ball?frames=500"))
    presses = [
        replace(p, mask=np.roll(p.mask, ASIDE, axis=1), center=(p.center[0] + ASIDE, p.center[1]))
        for p in right.presses
    ]
    return replace(right, presses=presses)


@pytest.fixture(scope="module")
def learned(session: Session) -> Photometry:
    """What is learned from them."""
    return fit_photometry(session, SCALE, BALL)


def test_the_middles_of_the_presses_are_found_to_a_fraction_of_a_pixel(
    session: Session, learned: Photometry
) -> None:
    scene = open_scene("ball?frames=500")
    raw = np.array([(scene.presses(p.seq)[0].x, scene.presses(p.seq)[0].y) for p in session.presses])
    off = learned.centers - PREPROCESS.mapping.to_processed(raw)
    assert np.sqrt((off**2).mean()) < 0.3
    assert learned.kept.all()


def test_errors_on_presses_that_were_not_learned_from_are_part_of_the_result(learned: Photometry) -> None:
    found = learned.found
    assert 0 < found.normal_error < 2
    assert 0 < found.depth_stderr < 0.1


def test_the_radius_at_which_the_gel_leaves_the_ball_is_found(session: Session) -> None:
    scene = open_scene("ball?frames=500")
    clings = [replace(p, core_radius=scene.presses(p.seq)[0].radius / 2) for p in session.presses]
    known = replace(session, presses=clings)
    ratio = fit_photometry(known, SCALE, BALL).found.core_ratio
    assert ratio == pytest.approx(1.0, abs=0.05)


def test_without_a_core_nothing_is_said_of_it(learned: Photometry) -> None:
    assert learned.found.core_ratio is None


@pytest.mark.parametrize(("scene", "worst"), [("press?seed=11", 0.03), ("cable?seed=11", 0.04)])
def test_heights_of_other_contacts_are_right_to_a_few_hundredths_of_the_depth(
    learned: Photometry, scene: str, worst: float
) -> None:
    shown = open_scene(scene)
    rest = Rest(PREPROCESS(shown.clean(0)))
    surface = Surface(learned.model, SCALE, learned.found.errors())
    for index in (60, 120):
        truth = shown.truth(index, PREPROCESS)
        sunk = truth.sunk * RAW_MM
        mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
        found = surface.depth(PREPROCESS(shown.clean(index)), rest, mask)
        around = sunk > 0.02 * sunk.max()
        assert np.sqrt(np.mean((found.heights - sunk)[around] ** 2)) < worst * sunk.max()
        assert found.volume == pytest.approx(sunk.sum() * SCALE.area(1.0), rel=0.15)
        assert found.greatest_stderr is not None
        assert abs(found.greatest - sunk.max()) < found.greatest_stderr < 0.15 * sunk.max()


def test_heights_are_right_where_one_of_the_lights_does_not_reach_every_slope() -> None:
    learned = fit_photometry(session_of(open_scene("ball?frames=260&light=dark_channel")), SCALE, BALL)
    shown = open_scene("cable?seed=11&frames=200&light=dark_channel")
    rest = Rest(PREPROCESS(shown.clean(0)))
    surface, errors = Surface(learned.model, SCALE), []
    for index in deepest(shown):
        truth = shown.truth(index, PREPROCESS)
        sunk = truth.sunk * RAW_MM
        mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
        off = surface.depth(noisy(PREPROCESS(shown.clean(index)), index), rest, mask).heights - sunk
        errors.append(np.sqrt(np.mean(off[sunk > 0.02 * sunk.max()] ** 2)) / sunk.max())
    # With colours that are averaged there, too, it is 0.06.
    assert max(errors) < 0.053


def test_stated_errors_of_the_depth_grow_where_slopes_are_steeper_than_the_ball_has_shown(
    learned: Photometry,
) -> None:
    off, stated = [], {}
    surface = Surface(learned.model, SCALE, learned.found.errors())
    for name in ("finger", "cable", "long_edge", "box", "coin"):
        shown = open_scene(f"{name}?seed=11&frames=200")
        rest = Rest(PREPROCESS(shown.clean(0)))
        for index in deepest(shown)[:2]:
            truth = shown.truth(index, PREPROCESS)
            mask = np.where(truth.contact_mask, 255, 0).astype(np.uint8)
            found = surface.depth(PREPROCESS(shown.clean(index)), rest, mask)
            assert found.greatest_stderr is not None
            stated[name] = found.greatest_stderr / found.greatest
            off.append((found.greatest - float(truth.sunk.max()) * RAW_MM) / found.greatest_stderr)
    assert stated["finger"] < 0.06 < stated["box"]
    assert np.mean(np.abs(off) < 1) > 0.4
    assert np.mean(np.abs(off) < 2) > 0.8


def test_a_press_that_is_no_ball_is_rejected(session: Session) -> None:
    odd = session.presses[5]
    turned = replace(session, presses=[*session.presses])
    turned.presses[5] = replace(odd, image=np.ascontiguousarray(odd.image[..., ::-1]))
    found = fit_photometry(turned, SCALE, BALL)
    assert np.flatnonzero(~found.kept).tolist() == [5]
    assert found.found.rejected == 1


@pytest.mark.parametrize(("count", "degrees"), [(1, 6.0), (3, 5.0)])
def test_few_presses_give_a_calibration_that_states_a_larger_error(
    session: Session, learned: Photometry, count: int, degrees: float
) -> None:
    few, others = session.presses[:count], session.presses[count::4]
    found = fit_photometry(replace(session, presses=few), SCALE, BALL)
    errors = summary(press_errors(replace(session, presses=others), found.model, SCALE, BALL))
    assert errors["normal_error"] < degrees
    assert found.found.presses == count
    assert found.found.normal_error > learned.found.normal_error
    assert found.found.between == found.found.depth_stderr


@pytest.mark.parametrize(
    ("chosen", "radius", "words"),
    [
        ([], BALL, "nothing touched the gel in 500 frames"),
        ([0] * 10, BALL, "press all over the gel"),
        (range(20), 0.6, "cannot make; give its radius, not its diameter"),
        (range(20), -1.0, "required a ball radius > 0 mm"),
    ],
)
def test_presses_that_give_no_calibration_are_refused_with_what_to_do(
    session: Session, chosen: Sequence[int], radius: float, words: str
) -> None:
    presses = [session.presses[i] for i in chosen]
    with pytest.raises(ConfigError, match=words):
        fit_photometry(replace(session, presses=presses), SCALE, radius)
