"""Numbers as plain values for JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from deworldsg_ros.evaluation.errors import EvaluationError
from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol.scoring import Count, ProtocolResult, ScanResult
from deworldsg_ros.evaluation.reports.evaluation import Evaluation
from deworldsg_ros.evaluation.runner import ScanOutcome
from deworldsg_ros.files import write_atomically


def protocol_values(result: ProtocolResult) -> dict[str, Any]:
    """Plain values of the official scores: recalls as fractions, NaN if undefined."""
    return {
        **result.numbers(),
        "counts": {
            "object": _count_values(result.objects),
            "predicate": _count_values(result.predicates),
            "relationship": _count_values(result.relationships),
        },
        "object_per_class": _class_values(result.object_classes),
        "predicate_per_class": _class_values(result.predicate_classes),
        "scans": [scan_values(scan) for scan in result.scans],
        "notes": result.notes,
    }


def scan_values(scan: ScanResult) -> dict[str, Any]:
    """Plain values of the scores of one scan."""
    return {
        "scan": scan.scan,
        "objects": {
            "hits": sum(ranked == 0 for ranked in scan.object_ranks),
            "total": len(scan.object_ranks),
            "found": len(scan.matching.prediction_of),
        },
        "predicates": _ranks_values(scan.predicate_ranks),
        "relationships": _ranks_values(scan.relationship_ranks),
        "predictions": len(scan.matching.supports),
        "void_predictions": sum(support is None for support in scan.matching.supports),
    }


def outcome_values(outcome: ScanOutcome) -> dict[str, Any]:
    """Plain values of the run of one scan: scores, times, drops, measures, checkpoints."""
    return {
        **scan_values(outcome.result),
        "frames": outcome.frames,
        "nodes": outcome.nodes,
        "edges": outcome.edges,
        "times_ms": outcome.times_ms,
        "drops": outcome.drops,
        "measures": measure_values(outcome.measures),
        "over_time": [asdict(item) for item in outcome.over_time],
    }


def evaluation_values(evaluation: Evaluation) -> dict[str, Any]:
    """Plain values of a whole evaluation."""
    return {**protocol_values(evaluation.result), "measures": measure_values(evaluation.pooled)}


def measure_values(measures: Measures) -> dict[str, Any]:
    """Plain values of the measures beside the protocol."""
    scores = measures.edge_scores()
    by_predicate = {name: item.numbers() for name, item in scores.items()}
    return {**measures.numbers(), "edges_by_predicate": by_predicate}


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as JSON, NaN and infinity as null; raises EvaluationError."""
    text = json.dumps(finite_or_none(values), indent=2, ensure_ascii=False, allow_nan=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text + "\n")
    except OSError as error:
        raise EvaluationError(f"--json {path} cannot be written ({error.strerror})") from error


def finite_or_none(value: Any) -> Any:
    """`value` with NaN and infinity replaced by None, which JSON can represent."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_none(item) for item in value]
    return value


def _class_values(counts: Mapping[str, Count]) -> dict[str, dict[str, float]]:
    return {
        name: {**_count_values(count), "recall": count.recall} for name, count in counts.items()
    }


def _count_values(count: Count) -> dict[str, int]:
    return {"hits": count.hits, "total": count.total}


def _ranks_values(ranks: list[int]) -> dict[str, int]:
    return {"hits": sum(ranked == 0 for ranked in ranks), "total": len(ranks)}
