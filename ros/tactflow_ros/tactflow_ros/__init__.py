"""Topics from a running tactflow. Needs rclpy, numpy and pyzmq, and nothing of tactflow itself."""
