"""Geometry: from raw to processed pixels and back, and the shape of the contact region.

`preprocess` makes the processed frame, by `downsample` or, with a `lens` or a `homography`, by `resample`;
`mapping` is the exact relation between the pixels of both. `valid_area` tells where the picture shows gel.
`moments` measures a region, `hull` describes the contact by that, and `direction` tells whether it has one.
"""

from tactflow.vision.geometry.homography import find_homography
from tactflow.vision.geometry.lens import Lens, check_lens
from tactflow.vision.geometry.mapping import PixelMapping
from tactflow.vision.geometry.preprocess import Method, Preprocessor

__all__ = ["Lens", "Method", "PixelMapping", "Preprocessor", "check_lens", "find_homography"]
