"""Runs a vision module in double precision, to see what its single precision costs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import cv2
import numpy as np

from tactflow.vision import compiled


class _Double:
    """A module in which everything of 32 bits is of 64 bits."""

    def __init__(self, module: Any, **replaced: Any) -> None:
        self._module = module
        self._replaced = replaced

    def __getattr__(self, name: str) -> Any:
        return self._replaced.get(name) or getattr(self._module, name)


def _distances(first: Any, second: Any, *rest: Any) -> Any:
    """OpenCV knows these in single precision only; they say who is near, and no position comes from them."""
    return cv2.batchDistance(first.astype(np.float32), second.astype(np.float32), cv2.CV_32F, *rest[1:])


NUMPY = _Double(np, float32=np.float64)
OPENCV = _Double(cv2, CV_32F=cv2.CV_64F, batchDistance=_distances)
DOUBLES = {"np": NUMPY, "cv2": OPENCV}


@contextmanager
def in_double(*modules: ModuleType) -> Iterator[None]:
    """Inside the `with` block the functions of these modules compute in float64 where they use float32.

    Compiled kernels have fixed types, and are not used.
    """
    before = [
        (module, name, getattr(module, name))
        for module in modules
        for name in DOUBLES
        if hasattr(module, name)
    ]
    try:
        for module, name, _ in before:
            setattr(module, name, DOUBLES[name])
        with compiled.switched(False):
            yield
    finally:
        for module, name, single in before:
            setattr(module, name, single)
