"""The surface of the gel as a cloud of points."""

from __future__ import annotations

from array import array

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from tactflow_ros.messages import METRES_PER_MM, Message, Unit

POINT = np.dtype([(name, "<f4") for name in ("x", "y", "z", "normal_x", "normal_y", "normal_z")])
"""One point, m, and the unit normal of the surface there."""
FIELDS = [
    PointField(name=name, offset=POINT.fields[name][1], datatype=PointField.FLOAT32, count=1)
    for name in POINT.names
]


def points(depth: np.ndarray, unit: Unit, step: int) -> np.ndarray:
    """The surface at every `step`-th pixel.

    z is negative where the gel is pressed in. The normals are those of the surface between neighbouring
    pixels, whatever the step, and point out of the gel.

    Parameters
    ----------
    depth : (H, W) float32, indentation, m, >= 0.
    unit : metres.
    step : >= 1.

    Returns
    -------
    (ceil(H / step), ceil(W / step)) of `POINT`.
    """
    # The surface is z = -depth(x, y), so its normal is along (d depth / dx, d depth / dy, 1).
    along_y, along_x = (slope[::step, ::step] for slope in np.gradient(depth, *unit.per_pixel[::-1]))
    length = np.sqrt(along_x**2 + along_y**2 + 1)
    rows, columns = (np.arange(0, size, step) for size in depth.shape)
    cloud = np.empty((len(rows), len(columns)), POINT)
    cloud["x"] = (columns - unit.origin[0]) * unit.per_pixel[0]
    cloud["y"] = ((rows - unit.origin[1]) * unit.per_pixel[1])[:, None]
    cloud["z"] = -depth[::step, ::step]
    for name, part in (("normal_x", along_x), ("normal_y", along_y), ("normal_z", 1.0)):
        cloud[name] = part / length
    return cloud


def surface(message: Message, data: bytes, head: Header, unit: Unit, step: int) -> PointCloud2:
    """The surface as an organised cloud, m: x, y, z, and the unit normal.

    message : of a depth map. data : (height, width) float32, little-endian, mm. unit, step : as for `points`.
    """
    width, height = message["size"]
    depth = np.frombuffer(data, "<f4", width * height).reshape(height, width) * np.float32(METRES_PER_MM)
    cloud = points(depth, unit, step)
    return PointCloud2(
        header=head,
        height=cloud.shape[0],
        width=cloud.shape[1],
        fields=FIELDS,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * cloud.shape[1],
        data=array("B", cloud.tobytes()),
        is_dense=True,
    )
