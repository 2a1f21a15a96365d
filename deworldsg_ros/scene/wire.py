"""The JSON messages of every topic, typed.

One msgspec Struct per message; `msg_schemas/` is generated from them. A time is {sec, nanosec},
because JSON numbers cannot hold 64-bit nanoseconds. Floats keep full precision (the shortest
decimal that reads back as the same float64), so that a graph over DDS equals one in process.
"""

from typing import Annotated, Any, Literal, TypeVar, Union

import msgspec

from deworldsg_ros.scene.errors import RefusedInput

# A reader of version N reads N - 1 too.
VERSION = 1

NonNegative = Annotated[int, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0 + 1e-9)]
Vector3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Box = Annotated[
    list[float], msgspec.Meta(min_length=4, max_length=4, description="x1 y1 x2 y2, pixels")
]
Matrix3 = Annotated[
    list[float], msgspec.Meta(min_length=9, max_length=9, description="3x3, row by row")
]
Matrix4 = Annotated[
    list[float], msgspec.Meta(min_length=16, max_length=16, description="4x4, row by row")
]


class Stamp(msgspec.Struct, frozen=True):
    """A ROS time."""

    sec: Annotated[int, msgspec.Meta(ge=-(2**31), lt=2**31)]
    nanosec: Annotated[int, msgspec.Meta(ge=0, lt=10**9)]


def stamp_from_ns(stamp_ns: int) -> Stamp:
    """Stamp of a time in nanoseconds."""
    sec, nanosec = divmod(stamp_ns, 10**9)
    return Stamp(sec=sec, nanosec=nanosec)


def ns_from_stamp(stamp: Stamp) -> int:
    """Time in nanoseconds of a stamp."""
    return stamp.sec * 10**9 + stamp.nanosec


class Schema(msgspec.Struct, frozen=True):
    """Name and version of a message's schema."""

    name: str
    version: Annotated[int, msgspec.Meta(ge=1)] = VERSION


class Message(msgspec.Struct, kw_only=True):
    """Fields of every message."""

    schema: Schema
    stamp: Stamp
    frame_id: str


class RelationLogits(msgspec.Struct):
    """Pre-sigmoid predicate logits of one ordered pair of a frame's objects."""

    subject: Annotated[int, msgspec.Meta(ge=0, description="row in objects")]
    object: Annotated[int, msgspec.Meta(ge=0, description="row in objects")]
    score: Probability
    logits: list[float]


class DetectedObject(msgspec.Struct):
    """One object in the image; its instance value is its row + 1."""

    box_xyxy: Box
    score: float
    class_probabilities: list[float]


class FrameGraphMessage(Message, kw_only=True):
    """deworldsg/frame_graph: the 2D scene graph of one frame; frame_id is the camera's."""

    width: NonNegative
    height: NonNegative
    classes: list[str]
    predicates: list[str]
    objects: list[DetectedObject]
    relations: list[RelationLogits]


class LiftedObject(msgspec.Struct):
    """One object as a 3D Gaussian in the world frame."""

    instance: Annotated[int, msgspec.Meta(ge=1, description="value in the instance image")]
    box_xyxy: Box
    score: float
    class_probabilities: list[float]
    mean_m: Vector3
    covariance_m2: Matrix3
    depth_m: float
    pixel_count: NonNegative
    surface_points_m: list[Vector3]


class DepthGridState(msgspec.Struct, frozen=True):
    """The depth image and the instance image on every n-th pixel, from pixel n // 2 on."""

    stride_px: Annotated[int, msgspec.Meta(ge=1)]
    fx: float
    fy: float
    cx: float
    cy: float
    depth_mm: Annotated[
        bytes, msgspec.Meta(description="row by row, uint16 little-endian, base64; 0 = invalid")
    ]
    instances: Annotated[
        bytes, msgspec.Meta(description="as depth_mm; 0 = no object; empty = not available")
    ] = b""


class LocalGraphMessage(Message, kw_only=True):
    """deworldsg/local_graph: the local 3D graph of one frame; frame_id is the world's."""

    width: NonNegative
    height: NonNegative
    T_world_camera: Matrix4
    classes: list[str]
    predicates: list[str]
    objects: list[LiftedObject]
    relations: list[RelationLogits]
    drops: dict[str, int] = {}
    depth_grid: Union[DepthGridState, None] = None


class PairEvidence(msgspec.Struct):
    """A geometric neighbour pair (Eq. 8), with the world model's prediction if there is one."""

    subject: Annotated[int, msgspec.Meta(ge=0, description="row in the local graph")]
    object: Annotated[int, msgspec.Meta(ge=0, description="row in the local graph")]
    subject_class: NonNegative
    object_class: NonNegative
    geo_cost: float
    prediction: list[float] = []


class RelationEvidenceMessage(Message, kw_only=True):
    """deworldsg/relation_evidence: pairs of the local graph with the same stamp."""

    classes: list[str]
    predicates: list[str]
    source: str
    pairs: list[PairEvidence]


class Belief(msgspec.Struct, frozen=True):
    """A label with its probability."""

    label: str
    probability: Probability


class GravityBox(msgspec.Struct, frozen=True):
    """A box around an object with one axis along `up`; points far from the others are left out."""

    center_m: Vector3
    size_m: Annotated[
        Vector3, msgspec.Meta(description="along the axes of the box; the third one is up")
    ]
    orientation_xyzw: Annotated[
        list[float],
        msgspec.Meta(min_length=4, max_length=4, description="axes of the box to world, unit"),
    ]


class NodeState(msgspec.Struct, frozen=True):
    """One object of the global graph."""

    id: Annotated[int, msgspec.Meta(ge=1, description="stable, never reused")]
    label: str
    classes: Annotated[list[Belief], msgspec.Meta(description="most probable first, top k")]
    mean_m: Vector3
    covariance_m2: Matrix3
    observations: Annotated[int, msgspec.Meta(ge=1)]
    first_seen: Stamp
    last_seen: Stamp
    confirmed: Annotated[
        bool,
        msgspec.Meta(description="false = hidden: its existence is below output.min_existence"),
    ] = True
    existence: Annotated[
        Union[Probability, msgspec.UnsetType],
        msgspec.Meta(description="probability that this is an object; absent = not estimated"),
    ] = msgspec.UNSET
    surface_points_m: list[Vector3] = []
    entropy_nats: Annotated[
        Union[float, None],
        msgspec.Meta(
            description="of the whole class distribution; high if observations disagree; "
            "null = not available"
        ),
    ] = None
    remainder: Annotated[
        Union[Probability, msgspec.UnsetType],
        msgspec.Meta(description="probability of all classes that are not listed"),
    ] = msgspec.UNSET
    box: Annotated[
        Union[GravityBox, msgspec.UnsetType],
        msgspec.Meta(description="absent = without surface points"),
    ] = msgspec.UNSET
    surface_mm: Annotated[
        Union[bytes, msgspec.UnsetType],
        msgspec.Meta(
            description="points of the surface relative to mean_m: x y z of each, int16 "
            "little-endian, millimetres, base64; replaces surface_points_m"
        ),
    ] = msgspec.UNSET


class HiddenNode(msgspec.Struct, frozen=True):
    """An object that was detected and is not in the graph, with the reason."""

    label: str
    mean_m: Vector3
    existence: Probability
    observations: Annotated[int, msgspec.Meta(ge=1)]
    reason: str


Provenance = Literal["visual", "prior", "fused"]


class EdgeState(msgspec.Struct, frozen=True):
    """One directed edge of the global graph."""

    subject: Annotated[int, msgspec.Meta(ge=1)]
    object: Annotated[int, msgspec.Meta(ge=1)]
    predicate: Annotated[str, msgspec.Meta(description="the most probable one")]
    probability: Annotated[
        Probability,
        msgspec.Meta(
            description="that this relation holds at all; with edge_belief paper: that it is this "
            "one, if any"
        ),
    ]
    predicates: Annotated[
        list[Belief],
        msgspec.Meta(
            description="most probable first, top k; the probabilities of all predicates sum to "
            "at most 1, and the rest is the probability of no relation"
        ),
    ]
    provenance: Annotated[
        Provenance,
        msgspec.Meta(description="visual = frames, prior = world model, fused = both"),
    ]
    entropy_nats: Annotated[
        float, msgspec.Meta(ge=0.0, description="of the visual distribution (uniform if none)")
    ]
    observations: Annotated[int, msgspec.Meta(ge=0, description="frames with visual evidence")]
    remainder: Annotated[
        Union[Probability, msgspec.UnsetType],
        msgspec.Meta(description="probability of all predicates that are not listed"),
    ] = msgspec.UNSET


Up = Annotated[
    Union[Vector3, msgspec.UnsetType],
    msgspec.Meta(description="unit vector against gravity in the world frame"),
]


class SceneGraphMessage(Message, kw_only=True):
    """/scene_graph: the whole graph after the update with this sequence number."""

    sequence: NonNegative
    nodes: list[NodeState]
    edges: list[EdgeState]
    up: Up = msgspec.UNSET
    hidden: Annotated[
        Union[list[HiddenNode], msgspec.UnsetType],
        msgspec.Meta(description="in saved files only"),
    ] = msgspec.UNSET


class RemovedNode(msgspec.Struct, frozen=True):
    """A removed node; after a merge, with the node that replaces it."""

    id: Annotated[int, msgspec.Meta(ge=1)]
    merged_into: Union[int, None] = None


class RemovedEdge(msgspec.Struct, frozen=True):
    """A removed edge."""

    subject: Annotated[int, msgspec.Meta(ge=1)]
    object: Annotated[int, msgspec.Meta(ge=1)]


class Association(msgspec.Struct, frozen=True):
    """Which node each object of a frame's local graph became, row by row."""

    stamp: Stamp
    nodes: list[int]


class SceneGraphUpdateMessage(Message, kw_only=True):
    """/scene_graph/updates: the changes between sequence - 1 and sequence.

    Apply removals first. Then replace each given node and edge.
    """

    sequence: Annotated[int, msgspec.Meta(ge=1)]
    removed_nodes: list[RemovedNode]
    removed_edges: list[RemovedEdge]
    nodes: list[NodeState]
    edges: list[EdgeState]
    associations: list[Association]
    up: Up = msgspec.UNSET


MESSAGES: dict[str, type[Message]] = {
    "frame_graph": FrameGraphMessage,
    "local_graph": LocalGraphMessage,
    "relation_evidence": RelationEvidenceMessage,
    "scene_graph": SceneGraphMessage,
    "scene_graph_updates": SceneGraphUpdateMessage,
}

M = TypeVar("M", bound=Message)


def schema_of(kind: type[Message]) -> Schema:
    """The schema header of messages of this type."""
    return Schema(next(name for name, known in MESSAGES.items() if known is kind))


def encode(message: Message) -> str:
    """JSON text of a message."""
    return msgspec.json.encode(message).decode()


def decode(text: Union[str, bytes], kind: type[M]) -> M:
    """Read and validate a message.

    Raises:
        RefusedInput: ``invalid_message`` if the text does not fit the schema,
            ``unknown_schema`` if it is another message or of a later version.
    """
    try:
        message = msgspec.json.decode(text, type=kind)
    except msgspec.MsgspecError as error:
        raise RefusedInput("invalid_message", f"{kind.__name__}: {error}") from error
    known = schema_of(kind)
    if message.schema.name != known.name or message.schema.version > known.version:
        raise RefusedInput(
            "unknown_schema",
            f"message is {message.schema.name} version {message.schema.version}: "
            f"expected {known.name} version {known.version} or older",
        )
    return message


def json_schema(kind: type[Message]) -> dict[str, Any]:
    """JSON Schema (2020-12) of a message."""
    schema = msgspec.json.schema(kind)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
