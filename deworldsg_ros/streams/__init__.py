"""Messages become arrays and are joined by stamp; no ROS is imported here."""
