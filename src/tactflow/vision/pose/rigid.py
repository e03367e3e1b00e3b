"""Rigid motions as 4 x 4 matrices, and covariances of small ones.

A small motion is (6,): translation, mm, then rotation vector, radians. The covariance (6, 6) of a motion T is
that of the small motion d in T @ rigid(d): in the axes of the object.
"""

from __future__ import annotations

import cv2
import numpy as np

from tactflow.vision.arrays import Floats


def rigid(small: Floats) -> Floats:
    """(4, 4) of a translation and a rotation vector, (6,).

    >>> rigid(np.array([1.0, 0, 0, 0, 0, np.pi / 2]))[:3].round(6).tolist()
    [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    """
    motion = np.eye(4)
    motion[:3, :3] = cv2.Rodrigues(small[3:])[0]
    motion[:3, 3] = small[:3]
    return motion


def vector(motion: Floats) -> Floats:
    """(6,): the inverse of `rigid`; rotations of up to 180 degrees."""
    return np.concatenate([motion[:3, 3], cv2.Rodrigues(motion[:3, :3])[0].ravel()])


def inverse(motion: Floats) -> Floats:
    """(4, 4): the motion back."""
    back = np.eye(4)
    back[:3, :3] = motion[:3, :3].T
    back[:3, 3] = -back[:3, :3] @ motion[:3, 3]
    return back


def adjoint(motion: Floats) -> Floats:
    """(6, 6): small motions d -> e with T @ rigid(d) = rigid(e) @ T.

    References
    ----------
    T. D. Barfoot, "State Estimation for Robotics", 2017, ch. 7.
    """
    turn = motion[:3, :3]
    carried = np.zeros((6, 6))
    carried[:3, :3] = carried[3:, 3:] = turn
    carried[:3, 3:] = skew(motion[:3, 3]) @ turn
    return carried


def skew(vectors: Floats) -> Floats:
    """(..., 3, 3): the matrices of the cross products with vectors (..., 3); row i is axis i x vector."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    matrices = np.zeros((*vectors.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2], matrices[..., 1, 2] = -z, y, -x
    matrices[..., 1, 0], matrices[..., 2, 0], matrices[..., 2, 1] = z, -y, x
    return matrices
