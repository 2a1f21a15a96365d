"""Faults of a run, in sentences: observations → findings, without files and without ROS.

`observations` is what a source knows: a run, or the diagnostics of running nodes. `frame_checks`
measures a few frames of a recording. `findings` turns all of it into causes and remedies.
"""

from deworldsg_ros.doctor.findings import Finding, find
from deworldsg_ros.doctor.frame_checks import FrameChecks, FrameSampler, Observations

__all__ = ["Finding", "FrameChecks", "FrameSampler", "Observations", "find"]
