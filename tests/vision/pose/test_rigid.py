"""Rigid motions."""

from __future__ import annotations

import numpy as np

from tactflow.vision.pose.rigid import adjoint, inverse, rigid, vector

MOTION = rigid(np.array([1.0, -2.0, 0.5, 0.3, -0.8, 1.1]))
SMALL = np.array([2e-6, 1e-6, -3e-6, 1e-6, 4e-6, -2e-6])


def test_a_motion_has_one_vector_and_one_inverse() -> None:
    np.testing.assert_allclose(vector(MOTION), [1.0, -2.0, 0.5, 0.3, -0.8, 1.1], atol=1e-12)
    np.testing.assert_allclose(inverse(MOTION) @ MOTION, np.eye(4), atol=1e-12)


def test_the_adjoint_carries_a_small_motion_to_the_other_side() -> None:
    after = rigid(adjoint(MOTION) @ SMALL) @ MOTION
    np.testing.assert_allclose(after, MOTION @ rigid(SMALL), atol=1e-10)
