"""Joining the messages of a posed RGB-D camera by stamp, without ROS.

`images`, `camera_info`, `poses` and `transforms` convert messages to arrays; they read attributes
only, so messages of ROS and of a bag both fit. `stamped` buffers one stream, `pose_stream` the
poses of one topic. `assembler` is the loop that joins a leading stream with others; `posed` adds
depth, camera_info and pose to it; `frame_assemblers` has the assemblers of the nodes (complete
frames, lifting, relations) and `unposed` the one of odometry. `jump_gate` refuses frames whose
pose jumps; `pending` keeps relation evidence until its local graph arrives.
"""
