"""ROS bags and the MCAP files of others as sources."""
