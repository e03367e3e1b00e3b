#!/usr/bin/env python3
"""Publish the results of a running tactflow as ROS 1 topics.

    python3 tactflow_ros1.py _endpoint:=tcp://127.0.0.1:5556 _sensor:=main _frame_id:=tactile_optical_frame

Needs rospy, std_msgs, geometry_msgs and pyzmq. Topics, units and stamps are a subset of the ROS 2 bridge's
(docs/robots.md): touching, contact, contact_pose, flow, and the last three with the suffix _pixels.
"""

import json
import math

import rospy
import zmq
from geometry_msgs.msg import Point32, PolygonStamped, PoseStamped, Vector3Stamped
from std_msgs.msg import Bool, Header

MM = 1e-3
KINDS = {"contact": PolygonStamped, "contact_pose": PoseStamped, "flow": Vector3Stamped}


def publish(topics, message, head):
    """Publish a message of tactflow, with lengths in pixels and, if it has a scale, in metres."""
    contact, scale = message["contact"], message.get("scale")
    mean = message["flow"] and message["flow"]["mean"]
    topics["touching"].publish(contact is not None)
    units = [("_pixels", (1.0, 1.0), (0.0, 0.0))]
    if scale is not None:
        units.append(("", [mm * MM for mm in scale["mm_per_px"]], scale["origin"]))
    for suffix, size, origin in units:
        outline = PolygonStamped(header=head)
        for x, y in contact["hull"] if contact else []:
            outline.polygon.points.append(Point32((x - origin[0]) * size[0], (y - origin[1]) * size[1], 0))
        topics["contact" + suffix].publish(outline)
        if contact is not None:
            pose = PoseStamped(header=head)
            x, y = contact["center"]
            pose.pose.position.x, pose.pose.position.y = (x - origin[0]) * size[0], (y - origin[1]) * size[1]
            # tactflow's angles are counter-clockwise on the screen; z points into the picture.
            half = -math.radians(contact["angle"] or 0.0) / 2
            pose.pose.orientation.z, pose.pose.orientation.w = math.sin(half), math.cos(half)
            topics["contact_pose" + suffix].publish(pose)
        if mean is not None:
            vector = Vector3Stamped(header=head)
            vector.vector.x, vector.vector.y = mean[0] * size[0], mean[1] * size[1]
            topics["flow" + suffix].publish(vector)


def main():
    """Receive and publish until shutdown."""
    rospy.init_node("tactflow")
    sensor = rospy.get_param("~sensor", "main")
    frame_id = rospy.get_param("~frame_id", "tactile_optical_frame")
    kinds = {"touching": Bool, **KINDS, **{f"{name}_pixels": kind for name, kind in KINDS.items()}}
    topics = {name: rospy.Publisher(f"~{name}", kind, queue_size=10) for name, kind in kinds.items()}
    socket = zmq.Context().socket(zmq.SUB)
    socket.subscribe(f"tactflow.{sensor} ".encode())
    endpoint = rospy.get_param("~endpoint", "tcp://127.0.0.1:5556")
    # ZeroMQ accepts IPv6 addresses only with this option.
    socket.setsockopt(zmq.IPV6, endpoint.startswith("tcp://["))
    socket.connect(endpoint)
    while not rospy.is_shutdown():
        if socket.poll(100):
            try:
                message = json.loads(socket.recv().partition(b" ")[2])
                t = message["t"]
            except (ValueError, TypeError, KeyError, RecursionError):
                rospy.logwarn_throttle(10, f"{endpoint}: a message that is not tactflow's")
                continue
            head = Header(stamp=rospy.Time(math.floor(t), round(t % 1 * 1e9)), frame_id=frame_id)
            publish(topics, message, head)


if __name__ == "__main__":
    main()
