"""Stage `blob_detector`: mask of the dots by OpenCV's SimpleBlobDetector."""

from __future__ import annotations

import math

import cv2
import numpy as np

from tactflow.engine.contract import Stage
from tactflow.parameters import MarkParams
from tactflow.ports import Image, MarkerMask, Valid
from tactflow.vision.markers.detection import detect_markers, to_gray
from tactflow.vision.markers.mask import Dot, find_dot


class BlobDetector(Stage):
    """Mask of the dots by SimpleBlobDetector: discs that many thresholds agree on.

    Use it for isolated round dots, and where no pixel outside a dot may be masked. Worn
    dots and those beside a contact are missing.

        marker_mask: {use: blob_detector}

    OpenCV, class SimpleBlobDetector; S. Suzuki, K. Abe, "Topological structural analysis of digitized binary
    images by border following", Computer Vision, Graphics, and Image Processing 30 (1985), for its outlines.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> mask = tactflow.stage("blob_detector").process(scene.frame(0))
    >>> bool(0.02 < (mask > 0).mean() < 0.3)
    True
    """

    memory = "stateful"

    class Params(MarkParams):
        """What the dots look like."""

    def __init__(self, params: Params) -> None:
        super().__init__(params)
        self.reset()

    def reset(self) -> None:
        """Forget the dots; a new reference follows."""
        self._known = False
        self._dot: Dot | None = None

    def process(self, image: Image, valid: Valid | None = None) -> MarkerMask:
        """Discs of 255 where a dot covers the gel; all 0 where the first frame showed none."""
        if not self._known:
            self._known = True
            params = self.params
            detect = self.once.keeping(detect_markers)
            self._dot = find_dot(
                image, radius=params.dot, polarity=params.polarity, valid=valid, detect=detect
            )
            self._detector = cv2.SimpleBlobDetector.create(self._settings())
        mask = np.zeros(image.shape[:2], np.uint8)
        if self._dot is not None:
            for blob in self._detector.detect(to_gray(image)):
                center = round(blob.pt[0]), round(blob.pt[1])
                cv2.circle(mask, center, math.ceil(max(blob.size / 2, self._dot.radius)) + 1, 255, cv2.FILLED)
        return mask

    def _settings(self) -> cv2.SimpleBlobDetector.Params:
        settings = cv2.SimpleBlobDetector.Params()
        if self._dot is not None:
            sizes = self._dot.radius, *self._dot.others
            settings.blobColor = 255 if self._dot.polarity == "bright" else 0
            # Discs of half to twice the area.
            settings.minArea = math.pi * min(sizes) ** 2 / 2
            settings.maxArea = math.pi * max(sizes) ** 2 * 2
            settings.minDistBetweenBlobs = min(sizes)
            settings.filterByCircularity = settings.filterByConvexity = settings.filterByInertia = False
        return settings
