"""Bridge from a running tactflow to ROS 2 topics. Needs rclpy, numpy and pyzmq, but not tactflow."""
