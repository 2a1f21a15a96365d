"""One method on a data set: scores and measures of predictions, of saved graphs, or of runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from deworldsg_ros.evaluation.measures import graph_measures
from deworldsg_ros.evaluation.measures.graph_measures import Measures
from deworldsg_ros.evaluation.protocol.predictions import read_predictions
from deworldsg_ros.evaluation.protocol.scoring import (
    ProtocolOptions,
    ProtocolResult,
    evaluate_predictions,
    pool,
)
from deworldsg_ros.evaluation.runner import (
    Checkpoint,
    ScanOutcome,
    evaluate_graph,
)
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene.frame_graph import Vocabulary
from deworldsg_ros.scene.graph_file import read_graph


@dataclass(frozen=True)
class Evaluation:
    """Scores and measures of one method.

    Attributes:
        method: name for tables and plots.
        dataset: name of the data set.
        vocabulary: classes and predicates of the data set.
        result: official scores over all scans.
        measures: further measures by scan; a scan without a prediction is missing.
        over_time: checkpoints by scan; empty unless the pipeline ran.
    """

    method: str
    dataset: str
    vocabulary: Vocabulary
    result: ProtocolResult
    measures: Mapping[str, Measures]
    over_time: Mapping[str, Sequence[Checkpoint]] = field(default_factory=dict)

    @cached_property
    def pooled(self) -> Measures:
        """Measures over all scans together."""
        return graph_measures.pool(self.measures.values())


def evaluate_prediction_file(
    annotations: Annotations,
    path: Path,
    options: ProtocolOptions,
    scans: Sequence[str] | None = None,
) -> Evaluation:
    """Evaluate the predictions of a file.

    Args:
        annotations: of the data set.
        path: predictions, ``.json`` or official ``.pkl``.
        options: of the protocol.
        scans: scans to evaluate; None = the split.

    Raises:
        DeWorldSGError: the predictions or the data set cannot be read.
    """
    predictions = read_predictions(path)
    result = evaluate_predictions(annotations, predictions, options, scans)
    measured = {}
    for scan in dict.fromkeys(item.scan for item in result.scans):
        if scan in predictions:
            points = annotations.points(scan, aligned=options.aligned_ply)
            reference = graph_measures.read_reference(annotations, scan, points)
            measured[scan] = graph_measures.measure_prediction(
                predictions[scan], annotations.vocabulary, reference
            )
    return Evaluation(
        path.name, annotations.root.resolve().name, annotations.vocabulary, result, measured
    )


def evaluate_saved_graphs(
    annotations: Annotations,
    folder: Path,
    options: ProtocolOptions,
    scans: Sequence[str] | None = None,
) -> Evaluation:
    """Evaluate ``folder/SCAN/scene_graph.json`` of each scan; arguments and errors as above."""
    chosen = scans or annotations.scans(options.split)
    evaluated = {
        scan: evaluate_graph(annotations, scan, read_graph(folder / scan), options)
        for scan in dict.fromkeys(chosen)
    }
    return Evaluation(
        folder.resolve().name,
        annotations.root.resolve().name,
        annotations.vocabulary,
        pool([evaluated[scan][0] for scan in chosen], annotations.vocabulary),
        {scan: measures for scan, (_, measures) in evaluated.items()},
    )


def evaluation_of_runs(
    annotations: Annotations, outcomes: Sequence[ScanOutcome], method: str
) -> Evaluation:
    """The evaluation of scans that the pipeline has processed."""
    return Evaluation(
        method,
        annotations.root.resolve().name,
        annotations.vocabulary,
        pool([outcome.result for outcome in outcomes], annotations.vocabulary),
        {outcome.scan: outcome.measures for outcome in outcomes},
        {outcome.scan: outcome.over_time for outcome in outcomes},
    )
