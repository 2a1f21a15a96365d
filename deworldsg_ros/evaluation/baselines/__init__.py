"""Baselines: other methods on the same detections, reimplemented here."""

from __future__ import annotations

from deworldsg_ros.evaluation.baselines.fross import Fross
from deworldsg_ros.evaluation.baselines.kim import Kim
from deworldsg_ros.evaluation.baselines.pipeline import Baseline, BaselinePipeline
from deworldsg_ros.evaluation.errors import EvaluationError

__all__ = ["BASELINES", "Baseline", "BaselinePipeline", "build_baseline"]

BASELINES: dict[str, type[Fross] | type[Kim]] = {"fross": Fross, "kim": Kim}


def build_baseline(name: str) -> Baseline:
    """The baseline of this name; raises EvaluationError."""
    if name not in BASELINES:
        raise EvaluationError(f"baseline '{name}': expected one of {', '.join(BASELINES)}")
    return BASELINES[name]()
