"""rosbag2 bags as messages, damaged ones too."""
