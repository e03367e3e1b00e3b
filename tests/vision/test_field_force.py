"""The displacement that the force on the whole gel is computed from, and that computation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tactflow.vision.field_force import FieldForce, between_dots, displacement, polynomial_terms
from tactflow.vision.flow.displacement_field import FieldModel
from tactflow.vision.types import Markers, MarkerStatus, Scale

SIZE = (160, 120)
SCALE = Scale(0.1, 0.2, (0.0, 0.0), (0.0, 0.0))


def pressed(pitch: float) -> Markers:
    """Dots of some spacing, px, on a gel that is dragged by (3, -1) px in the middle."""
    x, y = np.meshgrid(np.arange(pitch / 2, 160, pitch), np.arange(pitch / 2, 120, pitch))
    origin = np.column_stack([x.ravel(), y.ravel()])
    fading = np.exp(-np.square((origin - (80, 60)) / 40).sum(axis=1))[:, None]
    count = len(origin)
    return Markers(origin, origin + fading * (3, -1), np.zeros(count, np.uint8), np.full(count, 0.02))


def moved(markers: Markers) -> np.ndarray | None:
    """What the force is computed from."""
    return displacement(FieldModel(markers.origin, SIZE), markers, SCALE, SIZE)


def test_the_displacement_hardly_depends_on_which_dots_are_seen() -> None:
    dots = pressed(20)
    known = moved(dots)
    assert known is not None
    assert known.shape == (192, 2)
    # The four cells around the middle, where 0.97 of the drag is left: 3 px of 0.1 mm, 1 px of 0.2 mm.
    assert known[[87, 88, 103, 104]].mean(axis=0) == pytest.approx([0.29, -0.19], abs=0.01)
    others = moved(pressed(16))
    assert others is not None
    assert np.abs(known - others).max() < 0.02
    status = np.zeros(48, np.uint8)
    status[::5] = MarkerStatus.LOST
    fewer = moved(replace(dots, status=status))
    assert fewer is not None
    assert np.abs(known - fewer).max() < 0.05


def test_cells_beyond_the_outermost_dots_are_not_between_them() -> None:
    dots = np.array([[30.0, 20.0], [130.0, 20.0], [130.0, 100.0], [30.0, 100.0]])
    inside = between_dots(dots, SIZE).reshape(12, 16)
    assert inside[2:10, 3:13].all()
    assert inside.sum() == 8 * 10
    # Rows and columns of dots between them change nothing.
    assert (between_dots(np.vstack([dots, [[80.0, 60.0]]]), SIZE) == inside.ravel()).all()


def test_without_a_majority_of_the_dots_there_is_no_displacement() -> None:
    dots = pressed(20)
    status = np.full(48, MarkerStatus.LOST, np.uint8)
    status[:24] = MarkerStatus.TRACKED
    assert moved(replace(dots, status=status)) is not None
    status[23] = MarkerStatus.LOST
    assert moved(replace(dots, status=status)) is None


def test_the_scalar_product_of_terms_is_a_polynomial_of_that_of_the_scores() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 1, 5))
    product = float(a[0] @ b[0])
    assert float(polynomial_terms(a)[0] @ polynomial_terms(b)[0]) == pytest.approx(
        product + (0.1 * product) ** 2
    )


def test_arrays_that_do_not_match_are_refused() -> None:
    with pytest.raises(ValueError, match=r"required modes \(k, 2 S\)"):
        FieldForce(np.zeros((2, 96)), np.zeros((4, 3)))
    with pytest.raises(ValueError, match="displacement of 48 cells, got 2"):
        FieldForce(np.zeros((2, 96)), np.zeros((5, 3)))(np.zeros((2, 2)))
