"""rosbag2 bags as messages by role.

`storage` reads serialized messages with the readers of rosbags, which `readers` and `chunks` bound;
`salvage_mcap` and `salvage_sqlite` read those of damaged files. `topics` finds the topic of each
role, and `bag` is the `Source`.
"""
