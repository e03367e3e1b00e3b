"""Runs a vision module in double precision, to see what its single precision costs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from tactflow.vision.compiled import Kernel


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


def _run_plain(kernel: Kernel[..., Any], args: tuple[Any, ...]) -> Any:
    """Run a kernel as Python, whole numbers in 64 bits, as numba adds them: bytes of numpy overflow."""
    wide = [value.astype(np.int64) if _is_narrow(value) else value for value in args]
    result = kernel.plain(*wide)
    for given, filled in zip(args, wide, strict=True):
        if given is not filled and given.flags.writeable:
            given[...] = filled
    return result


def _is_narrow(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.dtype.itemsize < 8


@contextmanager
def in_double(*modules: ModuleType) -> Iterator[None]:
    """Inside the `with` block the functions of these modules compute in float64 where they use float32.

    Compiled kernels have fixed types: those of these modules run as the Python code that they are.
    """
    names = {module.__name__ for module in modules}
    call = Kernel.__call__

    def plain(self: Kernel[..., Any], *args: Any) -> Any:
        return _run_plain(self, args) if self.plain.__module__ in names else call(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            for name, double in DOUBLES.items():
                if hasattr(module, name):
                    patch.setattr(module, name, double)
        patch.setattr(Kernel, "__call__", plain)
        yield
