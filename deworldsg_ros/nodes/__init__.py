"""The ROS 2 nodes: a thin shell around one stage each."""
