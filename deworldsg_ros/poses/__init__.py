"""Camera poses: odometry, trajectory files, and perturbation."""
