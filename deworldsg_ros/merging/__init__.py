"""Stage c: local graphs become one global graph: association (Eq. 5-6) and fusion (Eq. 7)."""

from deworldsg_ros.merging.paper_rule import PaperMerging
from deworldsg_ros.merging.stage import Merging, build_merging
from deworldsg_ros.merging.surface_rule import SurfaceMerging

__all__ = ["Merging", "PaperMerging", "SurfaceMerging", "build_merging"]
