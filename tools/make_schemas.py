#!/usr/bin/env python3
"""Write msg_schemas/: a JSON Schema (2020-12) and an example of each message.

python tools/make_schemas.py [FOLDER]
"""

from __future__ import annotations

import inspect
import json
import struct
import sys
from pathlib import Path
from typing import Any

import msgspec

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from deworldsg_ros.wire import messages as wire  # noqa: E402

DRAFT = "https://json-schema.org/draft/2020-12/schema"
CLASSES = ["cup", "table", "chair"]
PREDICATES = ["on", "near", "under"]
STAMP = wire.Stamp(sec=12, nanosec=300_000_000)
EARLIER = wire.Stamp(sec=2, nanosec=100_000_000)
# Real ones have 512 values and more.
MODEL, VECTOR = "google/siglip2-base-patch16-224", struct.pack("<4e", 0.8, 0.0, -0.6, 0.0)
SESSION = "5f3c0a91b7d2e846"


def message_schema(name: str) -> dict[str, Any]:
    """The JSON Schema of a message. Its `schema.name` is a constant."""
    schema = {"$schema": DRAFT} | msgspec.json.schema(wire.MESSAGES[name])
    version = wire.schema_of(wire.MESSAGES[name]).version
    definition = schema["$defs"][wire.MESSAGES[name].__name__]
    for described in schema["$defs"].values():
        if "description" in described:  # a docstring; only Python 3.13 removes its indentation
            described["description"] = inspect.cleandoc(described["description"])
    definition["properties"]["schema"] = {
        "allOf": [
            {"$ref": "#/$defs/Schema"},
            {"properties": {"name": {"const": name}, "version": {"maximum": version}}},
        ]
    }
    return {**schema, "title": f"deworldsg_ros {name}, version {version}"}


def examples() -> dict[str, wire.Message]:
    """Each message by name, about a cup on a table."""
    return {**_frame_examples(), **_graph_examples()}


def _head(name: str, frame_id: str = "map") -> dict[str, Any]:
    schema = wire.schema_of(wire.MESSAGES[name])
    return {"schema": schema, "stamp": STAMP, "frame_id": frame_id}


def _frame_examples() -> dict[str, wire.Message]:
    """The messages of one frame."""
    relations = [wire.RelationLogits(subject=0, object=1, score=0.87, logits=[4.0, 1.5, -3.0])]
    words: dict[str, Any] = {"classes": CLASSES, "predicates": PREDICATES}
    image: dict[str, Any] = {"width": 640, "height": 480}
    return {
        "detections": wire.DetectionsMessage(
            **_head("detections", "camera_color_optical_frame"),
            detections=[
                wire.SentDetection(
                    box_xyxy=[310.0, 180.5, 352.0, 231.0],
                    hypotheses=[wire.NameScore("red mug", 0.71), wire.NameScore("cup", 0.2)],
                    mask=wire.SentMask(312, 182, 4, 3, bytes([0b01101111, 0b11110000])),
                    embedding=struct.pack("<4e", 0.5, -0.25, 0.0, 1.0),
                ),
                wire.SentDetection(
                    box_xyxy=[120.0, 215.0, 560.0, 402.5],
                    hypotheses=[wire.NameScore("desk", 0.83)],
                    mask=wire.SentMask(120, 216, 2, 2, bytes([0b11010000])),
                    embedding=struct.pack("<4e", 0.0, 1.0, 0.5, 0.25),
                ),
            ],
            embedding_model="openai/clip-vit-base-patch32",
        ),
        "frame_graph": wire.FrameGraphMessage(
            **_head("frame_graph", "camera_color_optical_frame"),
            **image,
            **words,
            objects=[
                wire.DetectedObject(
                    [310.0, 180.5, 352.0, 231.0],
                    0.91,
                    [0.94, 0.03, 0.03],
                    [41.5, 52.0, 30.5],
                    VECTOR,
                ),
                wire.DetectedObject([120.0, 215.0, 560.0, 402.5], 0.83, [0.02, 0.9, 0.08]),
            ],
            relations=relations,
            embedding_model=MODEL,
        ),
        "local_graph": wire.LocalGraphMessage(
            **_head("local_graph"),
            **image,
            T_world_camera=[
                1.0, 0.0, 0.0, 0.4,
                0.0, 0.0, 1.0, -1.8,
                0.0, -1.0, 0.0, 1.3,
                0.0, 0.0, 0.0, 1.0,
            ],
            **words,
            objects=[
                _lifted(1, [310.0, 180.5, 352.0, 231.0], 0, [0.42, 0.02, 0.8], 0.0009, 1780),
                _lifted(2, [120.0, 215.0, 560.0, 402.5], 1, [0.45, 0.1, 0.71], 0.09, 41_250),
            ],
            relations=relations,
            drops={"few_mask_pixels": 1},
            # The coarsest grid: one pixel in the middle, of the second object at 1.85 m.
            depth_grid=wire.DepthGridState(
                640, 525.0, 525.0, 319.5, 239.5, b"\x3a\x07", b"\x02\x00"
            ),
            embedding_model=MODEL,
        ),
        "relation_evidence": wire.RelationEvidenceMessage(
            **_head("relation_evidence"),
            **words,
            source="fake",
            pairs=[
                wire.PairEvidence(0, 1, 0, 1, 0.12, [0.7, 0.2, 0.1]),
                wire.PairEvidence(1, 0, 1, 0, 0.12),
            ],
        ),
    }  # fmt: skip


def _graph_examples() -> dict[str, wire.Message]:
    """The graph and its next update."""
    return {
        "scene_graph": wire.SceneGraphMessage(
            **_head("scene_graph"),
            session=SESSION,
            sequence=41,
            nodes=[_cup(), _node(2, "table", [0.45, 0.1, 0.71], 0.09, 29)],
            edges=[_cup_on_table()],
            up=[0.0, 0.0, 1.0],
            hidden=[wire.HiddenNode("vase", [1.0, 0.2, 0.9], 0.31, 2, "seen too little")],
            rooms=[_kitchen(), _hallway()],
            storeys_m=[0.0],
        ),
        "scene_graph_updates": wire.SceneGraphUpdateMessage(
            **_head("scene_graph_updates"),
            session=SESSION,
            sequence=42,
            removed_nodes=[wire.RemovedNode(id=7, merged_into=2), wire.RemovedNode(id=9)],
            removed_edges=[wire.RemovedEdge(subject=1, object=7)],
            nodes=[_cup()],
            edges=[_cup_on_table()],
            associations=[wire.Association(stamp=STAMP, nodes=[1, 2])],
            up=[0.0, 0.0, 1.0],
        ),
        "embeddings": wire.EmbeddingsMessage(
            **_head("embeddings"),
            session=SESSION,
            whole=False,
            model=MODEL,
            nodes=[wire.NodeEmbedding(id=1, vector=VECTOR)],
            removed=[7],
        ),
    }


def _lifted(
    instance: int,
    box: list[float],
    class_index: int,
    mean: list[float],
    variance: float,
    count: int,
) -> wire.LiftedObject:
    probabilities = [0.04, 0.04, 0.04]
    probabilities[class_index] = 0.92
    return wire.LiftedObject(
        instance=instance,
        box_xyxy=box,
        score=0.9,
        class_probabilities=probabilities,
        mean_m=mean,
        covariance_m2=_diagonal(variance),
        depth_m=1.82,
        pixel_count=count,
        surface=struct.pack("<6f", mean[0] - 0.02, *mean[1:], mean[0] + 0.02, *mean[1:]),
        colour_lab=[41.5, 52.0, 30.5],
        embedding=VECTOR,
    )


def _diagonal(variance: float) -> list[float]:
    return [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance / 4]


def _node(
    node_id: int, label: str, mean: list[float], variance: float, observations: int
) -> wire.NodeState:
    return wire.NodeState(
        id=node_id,
        label=label,
        classes=[wire.Belief(label, 0.92), wire.Belief("chair", 0.05)],
        mean_m=mean,
        covariance_m2=_diagonal(variance),
        observations=observations,
        first_seen=EARLIER,
        last_seen=STAMP,
        entropy_nats=0.32,
        remainder=0.03,
        box=wire.GravityBox(mean, [0.12, 0.1, 0.1], [0.0, 0.0, 0.0, 1.0]),
        surface_mm=b"\n\x00\x00\x00\xec\xff",
        colour_lab=[41.5, 52.0, 30.5],
    )


def _kitchen() -> wire.RoomState:
    return wire.RoomState(
        id=1,
        label="kitchen",
        kinds=[wire.Belief("kitchen", 0.93), wire.Belief("dining room", 0.04)],
        storey=0,
        outline_m=[[0.0, 0.0, 0.0], [3.2, 0.0, 0.0], [3.2, 2.9, 0.0], [0.0, 2.9, 0.0]],
        area_m2=9.28,
        doorways=[wire.Doorway(to=2, position_m=[3.26, 1.4, 0.0], width_m=0.85)],
        objects=[wire.RoomObject(id=1, probability=1.0), wire.RoomObject(id=2, probability=0.97)],
    )


def _hallway() -> wire.RoomState:
    return wire.RoomState(
        id=2,
        label="Anna's hall",
        kinds=[wire.Belief("hallway", 0.61), wire.Belief("bedroom", 0.14)],
        storey=0,
        outline_m=[[3.32, 0.0, 0.0], [4.6, 0.0, 0.0], [4.6, 6.0, 0.0], [3.32, 6.0, 0.0]],
        area_m2=7.68,
        doorways=[wire.Doorway(to=1, position_m=[3.26, 1.4, 0.0], width_m=0.85)],
        objects=[],
        label_provenance="operator",
    )


def _cup() -> wire.NodeState:
    return _node(1, "cup", [0.42, 0.02, 0.8], 0.0009, 24)


def _cup_on_table() -> wire.EdgeState:
    return wire.EdgeState(
        subject=1,
        object=2,
        predicate="on",
        probability=0.91,
        predicates=[wire.Belief("on", 0.91), wire.Belief("near", 0.08)],
        provenance="visual",
        entropy_nats=0.34,
        observations=23,
        remainder=0.01,
        shown=24,
    )


def files() -> dict[str, str]:
    """The text of each file in msg_schemas/ by file name."""
    texts: dict[str, str] = {}
    for name, example in examples().items():
        texts[f"{name}.schema.json"] = _pretty(message_schema(name))
        texts[f"{name}.example.json"] = _pretty(msgspec.to_builtins(example))
    return texts


def _pretty(content: Any) -> str:
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def main(folder: Path) -> None:
    """Write all files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files().items():
        (folder / name).write_text(text, encoding="utf-8")
        print(folder / name)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "msg_schemas")
