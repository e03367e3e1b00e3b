"""Every method that looks at pictures, as a function of a reference and an image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from tactflow.tools.stress.inputs import Image
from tactflow.vision.contact import ContactDetector
from tactflow.vision.markers.detection import detect_markers
from tactflow.vision.markers.inpaint import remove_markers
from tactflow.vision.markers.mask import Dot, find_dot, marker_mask
from tactflow.vision.markers.tracking import MarkerTracker
from tactflow.vision.types import Markers


def dog_mask(reference: Image, image: Image) -> Image:
    """The marker mask; empty where the reference shows no markers, as in the stage."""
    dot = find_dot(reference)
    return np.zeros(image.shape[:2], np.uint8) if dot is None else marker_mask(image, dot)


def detector(reference: Image) -> ContactDetector:
    """A detector with one reference."""
    contact = ContactDetector()
    contact.add_reference(reference)
    return contact


def contact_mask(reference: Image, image: Image) -> Image:
    """The contact mask of one image against one reference."""
    return detector(reference).detect(image).mask


def tracked(reference: Image, image: Image) -> Markers:
    """The markers of the reference in one image."""
    return MarkerTracker(reference, detect_markers(reference)).track(image)


def filled(method: Any, _reference: Image, image: Image) -> Image:
    """The image without what looks like markers of radius 3 px."""
    return remove_markers(image, marker_mask(image, Dot(3.0)), method=method)


INPAINTING = ("normalized", "telea", "ns", "none")
PICTURE_METHODS: Mapping[str, Callable[[Image, Image], Any]] = {
    "marker_mask": dog_mask,
    **{f"inpaint-{name}": partial(filled, name) for name in INPAINTING},
    "difference": contact_mask,
    "tracker": tracked,
}
"""Name -> callable of (reference, image)."""
