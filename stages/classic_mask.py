"""Stage `classic_mask`: the original script's mask of the dots, a difference of Gaussians."""

from __future__ import annotations

from tactflow.classic.functions import mask_marker
from tactflow.engine.contract import Stage
from tactflow.ports import Image, MarkerMask


class ClassicMask(Stage):
    """Mask of dark dots by a difference of Gaussians, as in the original script.

    Use it as the baseline. Its sizes and its threshold are those of one sensor: dots of 9 px diameter.

        marker_mask: {use: classic_mask}

    The script's `mask_marker`; D. Marr, E. Hildreth, "Theory of edge detection", Proceedings of the Royal
    Society B 207 (1980), for differences of Gaussians.

    >>> import tactflow
    >>> scene = tactflow.open_scene("press")
    >>> mask = tactflow.stage("classic_mask").process(scene.frame(0))
    >>> bool(0.02 < (mask > 0).mean() < 0.3)
    True
    """

    memory = "pure"

    def process(self, image: Image) -> MarkerMask:
        """255 where a marker covers the gel."""
        return mask_marker(image)
