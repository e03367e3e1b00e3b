"""Geometry: from raw to processed pixels and back, and the shape of the contact region."""

from tactflow.vision.geometry.preprocess import (
    Lens,
    Method,
    PixelMapping,
    Preprocessor,
    check_lens,
    find_homography,
)

__all__ = ["Lens", "Method", "PixelMapping", "Preprocessor", "check_lens", "find_homography"]
