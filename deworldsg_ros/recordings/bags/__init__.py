"""rosbag2 bags as messages by role.

`storage` reads serialized messages, `salvage_mcap` and `salvage_sqlite` those of damaged files,
`topics` finds the topic of each role, and `bag` is the `Source`.
"""
