"""Front ends: detections and relations of a backend, true boxes, a recording or ground truth.

Each is a `pipeline.Perceiver`. Methods of lifting and merging are compared on identical detections.
"""

from deworldsg_ros.evaluation.front_ends.choice import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.front_ends.faults import Faults, parse_faults

__all__ = ["Faults", "FrontEndChoice", "build_front_end", "parse_faults"]
