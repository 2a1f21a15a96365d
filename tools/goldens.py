#!/usr/bin/env python3
"""Hashes of everything that the package computes, to compare two versions of it.

    python tools/goldens.py [ROOMS] --out A.json      # in one checkout, and so in the other
    python tools/goldens.py --compare A.json B.json

A version that only moves code gives the same hashes on the same machine. ROOMS is the folder of the
rendered rooms; without it, only the shipped recording runs. A case hashes each update, the whole
graph, each array of the map, and contains the drops. Half-way, cases with edits save a map, go on
from it, and take in a pose correction and an operator's edits.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from typer.main import get_command
from typer.testing import CliRunner

from deworldsg_ros.cli.app import app
from deworldsg_ros.cli.configuration import described_yaml, effective_config
from deworldsg_ros.config import Config
from deworldsg_ros.evaluation.front_ends import FrontEndChoice, build_front_end
from deworldsg_ros.evaluation.recorded_room import open_annotations
from deworldsg_ros.graph.edits import DeleteNode, MergeNodes, SetLabel, SplitNode, Undo
from deworldsg_ros.graph.nodes import SAVED
from deworldsg_ros.graph_builder import GraphBuilder
from deworldsg_ros.map_file import copy_state, read_map, write_map
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import Recording, open_source
from deworldsg_ros.ros.options import Parameters, ReplayParameters
from deworldsg_ros.scene.errors import RefusedInput

Arrays = dict[str, "np.ndarray[Any, Any]"]
ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ROOT / "bags" / "demo_room"
CONFIGS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper_rules": (),
    # Its networks have no weights here: recorded detections, and the test double as world model.
    "released": ("relations.world_model=fake",),
}
ROOM_NAMES = ("rooms_0", "rooms_1")
# A pose correction of a few centimetres.
CORRECTION = np.array([[1, 0, 0, 0.03], [0, 1, 0, -0.02], [0, 0, 1, 0.01], [0, 0, 0, 1.0]])


@dataclass(frozen=True)
class Case:
    """One run: a recording, a configuration, a source of detections, and whether it is edited."""

    recording: str
    config: str
    front_end: str
    edited: bool = False

    @property
    def name(self) -> str:
        """Unique name of the case."""
        words = (self.recording, self.config, self.front_end, "edited" if self.edited else "")
        return " ".join(filter(None, words))


def cases(rooms: Path | None) -> Iterator[Case]:
    """The shipped recording and the rooms, with each configuration that runs there."""
    for config in ("default", "paper_rules"):
        for recording in ("shipped", *(ROOM_NAMES if rooms else ())):
            yield Case(recording, config, "backend")
        yield Case("shipped", config, "backend", edited=True)
    for config in CONFIGS if rooms else ():
        for recording in ROOM_NAMES:
            yield Case(recording, config, "recorded")
        yield Case("rooms_1", config, "recorded", edited=True)


def run(case: Case, rooms: Path | None, max_frames: int) -> dict[str, Any]:
    """The hashes of one case."""
    path = None if case.config == "default" else ROOT / "config" / f"{case.config}.yaml"
    config = effective_config(path, CONFIGS[case.config])
    pipeline, recording = _open(case, config, rooms)
    total = min(recording.frame_count, max_frames or recording.frame_count)
    updates = hashlib.sha256()
    refused: Counter[str] = Counter()
    for number, frame in enumerate(islice(recording.frames(), total)):
        if case.edited and number == total // 2:
            _go_on_from_map(pipeline, config)
        try:
            if case.edited and pipeline.builder is not None:
                _edit(pipeline.builder, number - total // 2)
            pipeline.process(frame)
        except RefusedInput as refusal:
            refused[refusal.reason] += 1
            continue
        assert pipeline.builder is not None
        updates.update(_json(pipeline.builder.update()))
    assert pipeline.builder is not None
    builder = pipeline.builder
    graph = builder.full()
    state = copy_state(builder)
    recording.close()
    return {
        "nodes": len(graph.nodes),
        "edges": len(graph.edges),
        "hidden": builder.hidden,
        "drops": dict(sorted((recording.drops + pipeline.drops + refused).items())),
        "updates": updates.hexdigest()[:16],
        "graph": _hash(_json(graph)),
        "map": {name: _array_hash(values) for name, values in sorted(_ordered(state).items())},
    }


def _open(case: Case, config: Config, rooms: Path | None) -> tuple[Pipeline, Recording]:
    if case.recording == "shipped":
        return Pipeline(config), Recording(open_source(SHIPPED), config.inputs)
    assert rooms is not None
    annotations = open_annotations(rooms, "replica")
    scan = case.recording
    source = open_source(annotations.scan_folder(scan))
    choice = FrontEndChoice("backend")
    if case.front_end == "recorded":
        choice = FrontEndChoice("recorded", flip=0.1)
    front_end = build_front_end(choice, annotations, scan, source, config)
    return Pipeline(config, front_end), Recording(source, config.inputs)


def _go_on_from_map(pipeline: Pipeline, config: Config) -> None:
    assert pipeline.builder is not None
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "golden.map"
        write_map(pipeline.builder, path)
        pipeline.go_on_with(read_map(config, path))


def _edit(builder: GraphBuilder, step: int) -> None:
    """The edit of a frame, if it has one; the steps are frames after the map was read."""
    if step == 10:
        nodes = builder.graph.nodes
        stamps = nodes.first_seen_ns[nodes.ids > 0]
        builder.apply_correction(CORRECTION, int(np.median(stamps)))
    ids = sorted(node.id for node in builder.full().nodes) if step in range(12, 60, 4) else []
    if len(ids) < 6:
        return
    requests = {
        12: SetLabel(ids[0], "thing of mine"),
        16: MergeNodes([ids[1], ids[2]]),
        20: SplitNode(ids[3]),
        24: DeleteNode(ids[-1]),
        28: Undo(),
        32: DeleteNode(ids[4]),
        36: SplitNode(ids[-2]),
        40: MergeNodes([ids[0], ids[-1]]),
        44: Undo(),
    }
    if step in requests:
        builder.edit(requests[step])


def surface() -> dict[str, str]:
    """Hashes of what users see of the options: help, defaults and parameters."""
    texts: dict[str, str] = {}
    waiting: list[tuple[str, ...]] = [()]
    while waiting:
        words = waiting.pop()
        texts[" ".join(("help", *words))] = CliRunner().invoke(app, [*words, "--help"]).output
        command: Any = get_command(app)
        for word in words:
            command = command.commands[word]
        waiting += [(*words, word) for word in getattr(command, "commands", ())]
    texts["configuration"] = described_yaml(Config())
    for kind in (Parameters, ReplayParameters):
        texts[kind.__name__] = msgspec.json.encode(msgspec.json.schema(kind)).decode()
    for path in sorted((ROOT / "msg_schemas").rglob("*.json")):
        texts[path.name] = path.read_text(encoding="utf-8")
    return {name: _hash(text.encode()) for name, text in texts.items()}


def _ordered(state: Arrays) -> Arrays:
    """The arrays of a map with nodes, edges and votes by their ids."""
    found = dict(state)
    order = state["ids"].argsort()
    for name in SAVED:
        found[name] = state[name][order]
    counts = state["surface_point_counts"]
    surfaces = np.split(state["surface_points"], np.cumsum(counts)[:-1])
    found["surface_point_counts"] = counts[order]
    found["surface_points"] = np.concatenate([surfaces[index] for index in order])
    order = np.lexsort(state["edge_pairs"].T[::-1])
    for name in ("edge_pairs", "edge_visual_logits", "edge_counts"):
        found[name] = state[name][order]
    found["edge_counts"] = found["edge_counts"][:, :3]
    order, voted = np.lexsort(state["vote_pairs"].T[::-1]), state["vote_known"][:, -1] == 1
    found["vote_pairs"] = state["vote_pairs"][order]
    found["vote_known"] = state["vote_known"][order][:, [0, -1]]
    places = np.cumsum(voted) - 1
    found["vote_counts"] = state["vote_counts"][places[order][voted[order]]]
    for name in ("header", "revisions"):
        found.pop(name, None)
    return found


def _json(value: Any) -> bytes:
    """JSON without the session, which differs in each run."""
    plain = msgspec.to_builtins(value)
    if isinstance(plain, dict):
        plain.pop("session", None)
    return msgspec.json.encode(plain)


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _array_hash(values: np.ndarray[Any, Any]) -> str:
    return f"{values.dtype} {values.shape} {_hash(np.ascontiguousarray(values).tobytes())}"


def compare(first: Path, second: Path) -> int:
    """Print what differs; the number of differences."""
    found = [json.loads(path.read_text(encoding="utf-8")) for path in (first, second)]
    differing = sorted(_differences("", *found))
    print("\n".join(differing) or "equal")
    return len(differing)


def _differences(name: str, one: Any, other: Any) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {*one, *other}:
            yield from _differences(f"{name} / {key}".strip(" /"), one.get(key), other.get(key))
    elif one != other:
        yield f"{name}: {one} != {other}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write hashes, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rooms", type=Path, nargs="?")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", default="", help="part of the names of the cases to run")
    parser.add_argument("--max-frames", type=int, default=0)
    parser.add_argument("--compare", type=Path, nargs=2)
    options = parser.parse_args(arguments)
    if options.compare:
        return int(compare(*options.compare) > 0)
    found: dict[str, Any] = {} if options.only else {"surface": surface()}
    for case in cases(options.rooms):
        if options.only in case.name:
            found[case.name] = run(case, options.rooms, options.max_frames)
            print(case.name, {**found[case.name], "map": "…"}, flush=True)
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
