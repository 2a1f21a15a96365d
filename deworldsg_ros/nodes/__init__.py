"""The ROS 2 nodes: each is a thin shell around one stage."""

from deworldsg_ros.nodes.start import keep_freed_memory

# Before the modules of a node: the threads that numpy and numba start take heaps of their own.
keep_freed_memory()
