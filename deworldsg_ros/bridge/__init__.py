"""The only place where ROS messages and numpy meet.

`images`, `poses`, `transforms` and `sync` know messages by their attributes alone and import no
rclpy, so that a bag read in one process takes the same path as the nodes.
"""
