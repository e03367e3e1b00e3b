"""Geometry: from raw to processed pixels and back, and the shape of the contact region.

`preprocess` makes the processed frame, by `downsample` or, with a `lens` or a homography, by `resample`;
`mapping` is the exact relation between the pixels of both. `valid_area` finds where the picture shows gel.
`region` measures a region, `hull` describes the contact, and `direction` decides whether it has a direction.
"""

from tactflow.vision.geometry.lens import Lens
from tactflow.vision.geometry.mapping import PixelMapping, find_homography
from tactflow.vision.geometry.preprocess import Method, Preprocessor

__all__ = ["Lens", "Method", "PixelMapping", "Preprocessor", "find_homography"]
