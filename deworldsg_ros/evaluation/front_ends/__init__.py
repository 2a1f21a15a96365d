"""Stage a from something else than a network: recorded, or from ground truth.

Each is a `pipeline.Perceiver`, so that lifting and merging are compared on identical input.
"""

from deworldsg_ros.evaluation.front_ends.choice import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.front_ends.faults import Faults, parse_faults

__all__ = ["Faults", "FrontEndChoice", "build_front_end", "parse_faults"]
