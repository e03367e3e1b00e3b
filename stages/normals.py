"""Stage `normals`: unit normal of the gel's surface at each pixel."""

from __future__ import annotations

from tactflow.engine.contract import Stage
from tactflow.ports import Normals
from tactflow.vision.depth.normals import surface_normals
from tactflow.vision.types import Depth, Scale


class SurfaceNormals(Stage):
    """Unit normals of the gel's surface, from the heights of the stage `depth` above.

    (0, 0, 1) where the gel is at rest. Absent where the heights are.

    >>> import numpy as np
    >>> import tactflow
    >>> depth = Depth(np.zeros((60, 80), np.float32), 0.0, None, 0.0, None)
    >>> scale = Scale(0.1, 0.1, (0.0, 0.0), (0.0, 0.0))
    >>> normals = tactflow.stage("normals").process(depth, scale)
    >>> float(normals[30, 40, 2])
    1.0
    """

    memory = "pure"

    def process(self, depth: Depth, scale: Scale) -> Normals:
        """The normals of the whole picture."""
        return surface_normals(depth.heights, scale)
