"""Compare the edges with a clip budget with the edges from all clips of every frame.

    python bench/clip_budget.py                                    the shipped recording
    python bench/clip_budget.py --rooms FOLDER                     rooms with recorded detections
    python bench/clip_budget.py --set relations.max_clips_per_s=2  another budget
    python bench/clip_budget.py --lead 0                           uncertain predictions

Both sides get the same local graphs and images. Two edges are equal if the same directed pair has
the same most probable predicate. The default world model is `fake`: the class pair determines the
most probable predicate of a clip. With --lead 0 the clips of a class pair differ, and the
predicates have nearly equal probabilities. The agreement then shows how much the mean of a few
clips differs from the mean of all.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from deworldsg_ros.cli.configuration import effective_config
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.relations import LiveGraph, RelationReasoner, build_world_model
from deworldsg_ros.relations.stage import QUEUE_SIZE
from deworldsg_ros.relations.world_model import FakeWorldModel
from deworldsg_ros.scene.frame_graph import LocalGraph
from deworldsg_ros.wire import messages as wire

BAG = Path(__file__).resolve().parents[1] / "bags" / "demo_room"
# The predicate of an edge is clear if its probability exceeds the second one by this.
LEAD = 0.05
# Maximum queue of the side that encodes all clips of a frame at once.
EVERY_CLIP_QUEUE_SIZE = 4096


class Side:
    """Merging and relations with one budget of clips."""

    def __init__(
        self, config: Config, first: LocalGraph, lead: float | None, queue_size: int
    ) -> None:
        model = build_world_model(config.relations, config.perception.device)
        if lead is not None:
            model = FakeWorldModel(config.relations.clip_length, lead_logit=lead)
        self.builder = GraphBuilder(config, first.vocabulary, first.frame_id)
        self.reasoner = RelationReasoner(config.relations, model, queue_size=queue_size)
        self.reasoner.watch(LiveGraph(self.builder.graph))
        self.seconds = 0.0

    def process(self, local: LocalGraph, rgb: np.ndarray) -> None:
        """Merge a frame and infer its relations."""
        self.builder.integrate(local)
        started_s = time.perf_counter()
        evidence = [self.reasoner.observe(local, rgb), *self.reasoner.drain()]
        self.seconds += time.perf_counter() - started_s
        for item in evidence:
            self.builder.add_evidence(item)

    def edges(self) -> dict[tuple[int, int], wire.EdgeState]:
        """The final edges by subject and object."""
        return {(edge.subject, edge.object): edge for edge in self.builder.full().edges}


def recordings(rooms: Path | None, config: Config) -> Iterator[tuple[str, Recording, Pipeline]]:
    """The name of each recording, the recording, and a pipeline without a world model."""
    no_world_model = msgspec.structs.replace(
        config, relations=msgspec.structs.replace(config.relations, world_model="none")
    )
    if rooms is None:
        source = open_source(BAG, inputs=config.inputs)
        yield "demo_room", Recording(source, config.inputs), Pipeline(no_world_model)
        return
    annotations = Annotations(rooms, "replica")
    for scan in sorted(folder.name for folder in (rooms / "data").iterdir()):
        source = open_source(annotations.scan_folder(scan))
        choice = FrontEndChoice("recorded")
        front_end = build_front_end(choice, annotations, scan, source, no_world_model)
        yield scan, Recording(source, config.inputs), Pipeline(no_world_model, front_end)


def compare(name: str, every: Side, chosen: Side, frames: int) -> None:
    """Print how far the edges of both sides agree, and the numbers of clips."""
    reference, edges = every.edges(), chosen.edges()
    counters = chosen.reasoner.counters()
    all_clips, clips = every.reasoner.counters().encoded, counters.encoded
    shared = [pair for pair in reference if pair in edges]
    same = [pair for pair in shared if edges[pair].predicate == reference[pair].predicate]
    clear = [pair for pair, edge in reference.items() if _lead(edge) > LEAD]
    agreed = set(same)
    differences = [abs(edges[p].probability - reference[p].probability) for p in shared]
    kinds = Counter(edge.provenance for edge in reference.values())
    print(f"{name}: {frames} frames, {all_clips} clips, {len(reference)} edges {dict(kinds)}")
    print(f"  clips encoded        {clips} ({clips / all_clips:.1%})")
    print(f"  same edges           {len(same) / len(reference):.1%}", end="")
    print(
        f" (same pairs {len(shared) / len(reference):.1%}, {len(edges) - len(shared)} other pairs)"
    )
    if clear:
        fraction = sum(pair in agreed for pair in clear) / len(clear)
        print(f"  of {len(clear)} with a lead above {LEAD}: {fraction:.1%}")
    print(f"  probability differs  mean {np.mean(differences):.4f}, maximum {max(differences):.4f}")
    print(f"  relations            {1e3 * chosen.seconds / frames:.1f} ms per frame", end="")
    print(f" (all: {1e3 * every.seconds / frames:.1f} ms)")
    print(
        f"  not encoded          {counters.dropped}, {counters.pending} pending at the end",
        flush=True,
    )


def _lead(edge: wire.EdgeState) -> float:
    probabilities = [belief.probability for belief in edge.predicates] + [0.0]
    return probabilities[0] - probabilities[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", type=Path, help="data set in the layout of ReplicaSSG")
    parser.add_argument("--config", type=Path, help="parameter file")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.FIELD=VALUE")
    parser.add_argument("--lead", type=float, help="extra logit of the top predicate of `fake`")
    parser.add_argument("--every", type=int, default=1, help="process every N-th frame")
    options = parser.parse_args()
    config = effective_config(options.config, ["relations.world_model=fake", *options.set])
    every_clip = msgspec.structs.replace(
        config, relations=msgspec.structs.replace(config.relations, max_clips_per_s=0.0)
    )
    for name, recording, pipeline in recordings(options.rooms, config):
        sides: list[Side] = []
        frames = 0
        for number, frame in enumerate(recording.frames()):
            if number % options.every:
                continue
            local = pipeline.process(frame).local
            if not sides:
                sides = [
                    Side(every_clip, local, options.lead, EVERY_CLIP_QUEUE_SIZE),
                    Side(config, local, options.lead, QUEUE_SIZE),
                ]
            for side in sides:
                side.process(local, frame.rgb)
            frames += 1
        compare(name, *sides, frames)


if __name__ == "__main__":
    main()
