"""Stage c: local graphs become one global graph: association (Eq. 5-6) and fusion (Eq. 7)."""

from deworldsg_ros.merging.stage import Merging

__all__ = ["Merging"]
