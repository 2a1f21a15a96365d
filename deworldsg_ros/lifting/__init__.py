"""Stage b: depth refinement (Eq. 1-2), back-projection and Gaussians (Eq. 3-4)."""

from deworldsg_ros.lifting.stage import Lifting

__all__ = ["Lifting"]
