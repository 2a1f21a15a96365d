"""The ROS 2 nodes: each is a thin shell around one stage."""
