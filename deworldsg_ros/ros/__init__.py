"""The border between ROS 2 and the rest of the package.

`node` is the base of every node (parameters, guarded callbacks, diagnostics, shutdown), `joining`
adds a worker thread behind joined streams, `waiting` waits for messages, and `process` runs one
node as a process. `options` and `parameters` declare ROS parameters; `health`, `reasons` and
`diagnosing` fill /diagnostics. `inputs` and `qos` subscribe to the camera in every supported type.
`perceiving` and `relating` are what nodes of stages a and d share, `models` supervises their
models. `graph_keeper` has the thread of the global graph; `update_times`, `whole_graph` and
`graph_files` are its parts. `markers` and `transform_output` write messages. Conversion of messages
to numpy, which needs no rclpy, is in `deworldsg_ros.streams`.
"""
