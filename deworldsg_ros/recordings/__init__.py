"""Recordings: rosbag2 bags and data set folders, read as the same stream of messages."""
