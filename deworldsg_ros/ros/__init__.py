"""The only place where ROS messages and numpy meet.

What turns messages into frames (`images`, `camera_info`, `poses`, `transforms`, `streams`,
`assembler`, `posed`, `sync`) knows them by their attributes alone and imports no rclpy, so that a
bag read in one process takes the same path as the nodes.
"""
