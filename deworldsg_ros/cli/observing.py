"""Observations of a run for the doctor, and the output of its findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.console import Console

from deworldsg_ros.cli.outputs import print_noted
from deworldsg_ros.doctor import Finding, FrameSampler, Observations, find
from deworldsg_ros.recordings.recording import Recording
from deworldsg_ros.scene import wire
from deworldsg_ros.scene.camera import RgbdFrame

if TYPE_CHECKING:  # all stages: `deworldsg demo` starts without them
    from deworldsg_ros.pipeline import FrameResult, Pipeline


class RunObserver:
    """Notes each frame of a run and its result."""

    def __init__(self) -> None:
        self._sampler = FrameSampler()
        self._turns: Counter[int] = Counter()
        self._detections = 0

    def note(self, frame: RgbdFrame, result: FrameResult) -> None:
        """Note a processed frame."""
        self._sampler.add(frame)
        self._turns[result.perceived.turns] += 1
        self._detections += len(result.perceived.frame_graph)

    def findings(
        self, recording: Recording, pipeline: Pipeline, drops: Mapping[str, Mapping[str, int]]
    ) -> list[Finding]:
        """What is off with the run so far.

        Args:
            recording: of the frames.
            pipeline: that processed them.
            drops: counts by owner and reason.
        """
        from deworldsg_ros.perception.stage import Perception

        perception, builder = pipeline.perception, pipeline.builder
        graph = None if builder is None else pipeline.graph()
        reasons: Counter[str] = Counter()
        for counts in drops.values():
            reasons.update(counts)
        seen = Observations(
            images=recording.frame_count,
            frames=self._turns.total(),
            drops=reasons,
            examples=recording.reasons,
            nodes=0 if graph is None else len(graph.nodes),
            hidden={} if builder is None else builder.hidden,
            detections=self._detections,
            classes=perception.vocabulary.classes if isinstance(perception, Perception) else (),
            sizes=() if graph is None else sizes_of(graph),
            turns=self._turns,
            checks=self._sampler.checks(),
        )
        return find(seen)


def sizes_of(graph: wire.SceneGraphMessage) -> tuple[tuple[str, float], ...]:
    """Label and longest side in metres of each node."""
    return tuple((node.label, max(node.box.size_m)) for node in graph.nodes if node.box)


def print_findings(console: Console, findings: Sequence[Finding]) -> None:
    """Print each finding as a paragraph of one line."""
    for finding in findings:
        print_noted(console, "note:" if finding.harmless else "check:", str(finding))


def as_report(findings: Sequence[Finding]) -> list[dict[str, Any]]:
    """Findings for run.json."""
    return [asdict(finding) for finding in findings]
