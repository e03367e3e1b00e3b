"""Geometry: from raw to processed pixels and back, and the shape of the contact region."""

from tactflow.vision.geometry.homography import find_homography
from tactflow.vision.geometry.lens import Lens, check_lens
from tactflow.vision.geometry.mapping import PixelMapping
from tactflow.vision.geometry.preprocess import Method, Preprocessor

__all__ = ["Lens", "Method", "PixelMapping", "Preprocessor", "check_lens", "find_homography"]
