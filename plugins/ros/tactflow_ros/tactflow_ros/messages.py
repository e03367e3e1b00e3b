"""Convert tactflow's messages to ROS messages.

Lengths in tactflow are pixels of the processed picture (x right, y down); with a calibration, `scale`
converts them to millimetres. Here, lengths are metres (REP 103) or, in topics with the suffix `_pixels`,
pixels.
"""

from __future__ import annotations

import math
from array import array
from typing import Any, NamedTuple

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point32,
    PolygonStamped,
    PoseStamped,
    TransformStamped,
    Vector3Stamped,
    WrenchStamped,
)
from sensor_msgs.msg import CompressedImage, Image, PointCloud2, PointField
from std_msgs.msg import Header

Message = dict[str, Any]

METRES_PER_MM = 1e-3
"""Metres per millimetre."""
NANOSECONDS_PER_SECOND = 1_000_000_000
"""Nanoseconds per second."""
MIN_UNIX_TIME_S = 1e9
"""Times above this are Unix times of a live source; those of a recording start at 0, s."""

STATUS = {"tracked": 0, "inferred": 1, "lost": 2}
"""Status of a marker -> its number in the cloud."""
MARKER = np.dtype(
    {
        "names": ["x", "y", "z", "dx", "dy", "stderr", "status"],
        "formats": ["<f4"] * 6 + ["u1"],
        "itemsize": 28,
    }
)
"""One point of the cloud of markers."""
FIELDS = [
    PointField(
        name=name,
        offset=MARKER.fields[name][1],
        datatype=PointField.UINT8 if name == "status" else PointField.FLOAT32,
        count=1,
    )
    for name in MARKER.names
]


class Unit(NamedTuple):
    """A unit of length.

    Attributes
    ----------
    per_pixel : units per pixel in (x, y).
    origin : (x, y), px.
    suffix : of topic names.
    """

    per_pixel: tuple[float, float]
    origin: tuple[float, float]
    suffix: str

    def places(self, points: Any) -> np.ndarray:
        """Convert positions (N, 2) from pixels."""
        return (np.asarray(points, float).reshape(-1, 2) - self.origin) * self.per_pixel

    def vectors(self, vectors: Any) -> np.ndarray:
        """Convert displacements (N, 2) from pixels."""
        return np.asarray(vectors, float).reshape(-1, 2) * self.per_pixel


PIXELS = Unit((1.0, 1.0), (0.0, 0.0), "_pixels")


def units(message: Message) -> list[Unit]:
    """Pixels, and metres if the sensor is calibrated."""
    scale = message.get("scale")
    if scale is None:
        return [PIXELS]
    x, y = scale["mm_per_px"]
    return [PIXELS, Unit((x * METRES_PER_MM, y * METRES_PER_MM), tuple(scale["origin"]), "")]


def stamp(t: float) -> Time:
    """Convert a capture time, s."""
    # A double cannot hold a Unix time in nanoseconds, so split it first.
    nanoseconds = math.floor(t) * NANOSECONDS_PER_SECOND + round(t % 1 * NANOSECONDS_PER_SECOND)
    return Time(sec=nanoseconds // NANOSECONDS_PER_SECOND, nanosec=nanoseconds % NANOSECONDS_PER_SECOND)


def header(message: Message, frame_id: str) -> Header:
    """Capture time and frame."""
    return Header(stamp=stamp(message["t"]), frame_id=frame_id)


def polygon(message: Message, head: Header, unit: Unit) -> PolygonStamped:
    """Convex hull of the contact; empty without contact."""
    contact = message["contact"]
    result = PolygonStamped(header=head)
    if contact is not None:
        result.polygon.points = [Point32(x=x, y=y) for x, y in unit.places(contact["hull"]).tolist()]
    return result


def pose(message: Message, head: Header, unit: Unit) -> PoseStamped | None:
    """Centre of the contact, with the x axis along its direction (or along the frame's x if it has none)."""
    contact = message["contact"]
    if contact is None:
        return None
    result = PoseStamped(header=head)
    place = result.pose.position
    ((place.x, place.y),) = unit.places(contact["center"]).tolist()
    _turn(result, contact["angle"] or 0.0)
    return result


def object_pose(message: Message, head: Header) -> PoseStamped | None:
    """The object that touches the gel; its axes were those of the frame when it was touched. None if lost."""
    found = message.get("pose")
    if found is None or found["status"] != "tracked":
        return None
    result = PoseStamped(header=head)
    place, turn = result.pose.position, result.pose.orientation
    moved = zip(found["center"], found["translation"], strict=True)
    place.x, place.y, place.z = ((start + way) * METRES_PER_MM for start, way in moved)
    angle = math.radians(math.hypot(*found["rotation"]))
    # The sine of half of the angle over the angle in degrees, which has a limit at 0.
    part = math.sin(angle / 2) / math.degrees(angle) if angle else math.radians(0.5)
    turn.x, turn.y, turn.z = (part * axis for axis in found["rotation"])
    turn.w = math.cos(angle / 2)
    return result


def transform(pose: PoseStamped, child_frame_id: str) -> TransformStamped:
    """The same pose as a transform from the frame of the sensor to that of the object."""
    result = TransformStamped(header=pose.header, child_frame_id=child_frame_id)
    place, shift = pose.pose.position, result.transform.translation
    shift.x, shift.y, shift.z = place.x, place.y, place.z
    result.transform.rotation = pose.pose.orientation
    return result


def flow(message: Message, head: Header, unit: Unit) -> Vector3Stamped | None:
    """Mean displacement of the gel in contact."""
    mean = message["flow"] and message["flow"]["mean"]
    if mean is None:
        return None
    result = Vector3Stamped(header=head)
    ((result.vector.x, result.vector.y),) = unit.vectors(mean).tolist()
    return result


def slip(message: Message, head: Header, unit: Unit) -> PoseStamped | None:
    """How far the object has moved over the gel, and how far it has turned on it."""
    found = message.get("slip")
    if found is None or found.get("translation") is None:
        return None
    result = PoseStamped(header=head)
    place = result.pose.position
    ((place.x, place.y),) = unit.vectors(found["translation"]).tolist()
    _turn(result, found["rotation"])
    return result


def _turn(result: PoseStamped, angle: float) -> None:
    """tactflow's angles are counter-clockwise on the screen; the frame's z points into the picture."""
    half = -math.radians(angle) / 2
    result.pose.orientation.z, result.pose.orientation.w = math.sin(half), math.cos(half)


def markers(message: Message, head: Header, unit: Unit) -> PointCloud2 | None:
    """A point for each marker: x, y, z (0), dx, dy, stderr (NaN: unknown), status."""
    dots = message["markers"]
    if dots is None:
        return None
    count = len(dots["status"])
    cloud = np.zeros(count, MARKER)
    place, origin = unit.places(dots["position"]), unit.places(dots["origin"])
    cloud["x"], cloud["y"] = place.T
    cloud["dx"], cloud["dy"] = (place - origin).T
    errors = np.array(dots.get("stderr") or [None] * count, float)
    cloud["stderr"] = errors * math.sqrt(unit.per_pixel[0] * unit.per_pixel[1])
    cloud["status"] = [STATUS.get(word, STATUS["lost"]) for word in dots["status"]]
    return PointCloud2(
        header=head,
        height=1,
        width=count,
        fields=FIELDS,
        is_bigendian=False,
        point_step=MARKER.itemsize,
        row_step=MARKER.itemsize * count,
        data=array("B", cloud.tobytes()),
        is_dense=True,
    )


def wrench(message: Message, head: Header) -> WrenchStamped | None:
    """Force on the gel, acting at the centre of the contact, and its torque about the origin of the frame.

    Components that are not known are NaN: shear and twist without a calibration of the shear, every torque
    if no contact is found.
    """
    force = message.get("force")
    if force is None:
        return None
    result = WrenchStamped(header=head)
    x, y, pressed, twist = (
        math.nan if part is None else float(part) for part in (*force["value"], force.get("torque"))
    )
    # Pressing is negative because z points out of the gel.
    result.wrench.force.x, result.wrench.force.y, result.wrench.force.z = x, y, -pressed
    contact, metres = message["contact"], units(message)[-1]
    known = contact is not None and metres is not PIXELS
    ((at_x, at_y),) = metres.places(contact["center"] if known else (math.nan, math.nan)).tolist()
    torque = result.wrench.torque
    torque.x, torque.y = -at_y * pressed, at_x * pressed
    torque.z = at_x * y - at_y * x + twist * METRES_PER_MM
    return result


def picture(message: Message, data: bytes, frame_id: str) -> CompressedImage:
    """The processed picture."""
    return CompressedImage(header=header(message, frame_id), format="jpeg", data=array("B", data))


def depth(message: Message, data: bytes, frame_id: str) -> Image:
    """Depth of the indentation, m. data : (height, width) float32, little-endian, mm."""
    width, height = message["size"]
    metres = np.frombuffer(data, "<f4", width * height) * np.float32(METRES_PER_MM)
    return Image(
        header=header(message, frame_id),
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=array("B", metres.tobytes()),
    )
