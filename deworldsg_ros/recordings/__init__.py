"""Recordings: rosbag2 bags and data set folders, read as the same stream of messages.

Start at `recording`: `open_source` opens a bag or a folder as a `Source` of messages by role
(`source`, `messages`), and `Recording` joins these messages to frames with poses, with the
assembler of the nodes. `bags` reads rosbag2, damaged files too; `folders` reads data sets, one file
each, and their annotations. `posing` replaces the poses of a recording (trajectory, odometry,
noise). `replaying` serves the replay node, and converts a source to an MCAP file.
Imports point one way: errors, messages <- source <- bags, folders <- recording <- posing.
"""
