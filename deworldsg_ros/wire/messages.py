"""The JSON messages of every topic, typed.

One msgspec Struct per message; `msg_schemas/` is generated from them. A time is {sec, nanosec},
because JSON numbers cannot hold 64-bit nanoseconds. Floats keep full precision (the shortest
decimal that reads back as the same float64), so that a graph over DDS equals one in process.
"""

from collections import Counter
from functools import cache, lru_cache
from typing import Annotated, Any, Literal, Optional, TypeVar, Union

import msgspec

from deworldsg_ros.scene.errors import RefusedInput
from deworldsg_ros.scene.limits import (
    MAX_COORDINATE_M,
    MAX_COST,
    MAX_EMBEDDING,
    MAX_FRAME_BYTES,
    MAX_GRAPH_BYTES,
    MAX_INSTANCE,
    MAX_MASK_BYTES,
    MAX_NAME_CHARACTERS,
    MAX_NAMES,
    MAX_OBJECTS,
    MAX_PAIRS,
    MAX_POINTS,
    MAX_REASON_CHARACTERS,
    MAX_RELATIONS,
    MAX_ROOMS,
    MAX_SECONDS,
    MAX_SIDE_PX,
    check_labels,
    checked_frame_id,
)
from deworldsg_ros.wire.fields import (
    POINT_BYTES,
    Box,
    Colour,
    Covariance,
    Distribution,
    Embedding,
    Focal,
    Height,
    Logits,
    Matrix3,
    Model,
    Name,
    Names,
    NonNegative,
    Points,
    Positive,
    Probability,
    RgbGrid,
    Row,
    Side,
    Size3,
    UnitPart,
    Vector3,
    Vector16,
)
from deworldsg_ros.wire.fields import NodeId as NodeId
from deworldsg_ros.wire.fields import Point as Point
from deworldsg_ros.wire.fields import Pose as Pose

# A reader of version N reads N - 1 too. Version 2 of the graph added up, boxes, remainders, compact
# surfaces and mutual edges; that of a local graph has compact surfaces.
VERSION = 1
VERSIONS = {"local_graph": 2, "scene_graph": 2, "scene_graph_updates": 2}


# gc=False: a graph has millions of these, and none is in a cycle. The collector skips them.
class Stamp(msgspec.Struct, frozen=True, gc=False):
    """A ROS time."""

    sec: Annotated[int, msgspec.Meta(ge=0, le=MAX_SECONDS)]
    nanosec: Annotated[int, msgspec.Meta(ge=0, lt=10**9)]


@lru_cache(maxsize=1024)
def stamp_from_ns(stamp_ns: int) -> Stamp:
    """Stamp of a time in nanoseconds."""
    return Stamp(*divmod(stamp_ns, 10**9))


def ns_from_stamp(stamp: Stamp) -> int:
    """Time in nanoseconds of a stamp."""
    return stamp.sec * 10**9 + stamp.nanosec


class Schema(msgspec.Struct, frozen=True):
    """Name and version of a message's schema."""

    name: str
    version: Positive = VERSION


class Message(msgspec.Struct, kw_only=True):
    """Fields of every message."""

    schema: Schema
    stamp: Stamp
    frame_id: Name


class RelationLogits(msgspec.Struct):
    """Pre-sigmoid predicate logits of one ordered pair of a frame's objects."""

    subject: Annotated[Row, msgspec.Meta(description="row in objects")]
    object: Annotated[Row, msgspec.Meta(description="row in objects, another one")]
    score: Probability
    logits: Logits


class DetectedObject(msgspec.Struct):
    """One object in the image; its instance value is its row + 1."""

    box_xyxy: Box
    score: Probability
    class_probabilities: Distribution
    colour_lab: Colour = msgspec.UNSET
    embedding: Embedding = msgspec.UNSET


class NameScore(msgspec.Struct):
    """What an object may be."""

    name: Annotated[
        str,
        msgspec.Meta(
            min_length=1,
            max_length=MAX_NAME_CHARACTERS,
            description="free text, also one that was never sent before",
        ),
    ]
    score: Probability


class SentMask(msgspec.Struct):
    """The pixels of an object, as a part of the image."""

    left: Annotated[int, msgspec.Meta(ge=0, lt=MAX_SIDE_PX, description="column of the image")]
    top: Annotated[int, msgspec.Meta(ge=0, lt=MAX_SIDE_PX, description="row of the image")]
    width: Side
    height: Side
    bits: Annotated[
        bytes,
        msgspec.Meta(
            max_length=MAX_MASK_BYTES,
            description="a bit a pixel, row by row, the highest bit first (numpy.packbits), base64",
        ),
    ]


class SentDetection(msgspec.Struct):
    """One object that a detector of yours has found."""

    box_xyxy: Box
    hypotheses: Annotated[
        list[NameScore],
        msgspec.Meta(
            min_length=1,
            max_length=MAX_NAMES,
            description="names with their scores, in any order, one at least. If the scores sum to "
            "one, they are the distribution of the class; otherwise the rest is what the detector "
            "leaves open",
        ),
    ]
    score: Annotated[
        Union[Probability, msgspec.UnsetType],
        msgspec.Meta(description="of the object; without it, the highest of its names"),
    ] = msgspec.UNSET
    mask: Annotated[
        Optional[SentMask], msgspec.Meta(description="of all objects of a message, or of none")
    ] = None
    embedding: Annotated[
        bytes,
        msgspec.Meta(
            max_length=2 * MAX_EMBEDDING,
            description="float16 little-endian, base64, as long for all objects, or empty",
        ),
    ] = b""


class DetectionsMessage(Message, kw_only=True):
    """deworldsg/detections: what a detector of yours has found in an image.

    The stamp is that of the image, and frame_id that of the camera.
    """

    detections: Annotated[list[SentDetection], msgspec.Meta(max_length=MAX_OBJECTS)]
    embedding_model: Annotated[
        Name, msgspec.Meta(description="name of the model that made the embeddings")
    ] = ""


class FrameGraphMessage(Message, kw_only=True):
    """deworldsg/frame_graph: the 2D scene graph of one frame; frame_id is the camera's."""

    width: Side
    height: Side
    classes: Names
    predicates: Names
    objects: Annotated[list[DetectedObject], msgspec.Meta(max_length=MAX_OBJECTS)]
    relations: Annotated[list[RelationLogits], msgspec.Meta(max_length=MAX_RELATIONS)]
    embedding_model: Model = msgspec.UNSET
    rgb_grid: RgbGrid = b""


class LiftedObject(msgspec.Struct):
    """One object as a 3D Gaussian in the world frame."""

    instance: Annotated[
        int,
        msgspec.Meta(
            ge=1, le=MAX_INSTANCE, description="value in the instance image, each only once"
        ),
    ]
    box_xyxy: Box
    score: Probability
    class_probabilities: Distribution
    mean_m: Point
    covariance_m2: Covariance
    depth_m: Annotated[float, msgspec.Meta(ge=0.0, le=MAX_COORDINATE_M)]
    pixel_count: Annotated[int, msgspec.Meta(ge=1, le=MAX_SIDE_PX**2)]
    surface_points_m: Annotated[
        Union[Points, msgspec.UnsetType], msgspec.Meta(description="of version 1")
    ] = msgspec.UNSET
    surface: Annotated[
        bytes,
        msgspec.Meta(
            max_length=POINT_BYTES * MAX_POINTS,
            description="points of the surface: x y z of each, float32 little-endian, metres, "
            "base64; replaces surface_points_m",
        ),
    ] = b""
    colour_lab: Colour = msgspec.UNSET
    embedding: Embedding = msgspec.UNSET


class DepthGridState(msgspec.Struct, frozen=True):
    """The depth image and the instance image on every n-th pixel, from pixel n // 2 on."""

    stride_px: Side
    fx: Focal
    fy: Focal
    cx: Focal
    cy: Focal
    depth_mm: Annotated[
        bytes, msgspec.Meta(description="row by row, uint16 little-endian, base64; 0 = invalid")
    ]
    instances: Annotated[
        bytes, msgspec.Meta(description="as depth_mm; 0 = no object; empty = not available")
    ] = b""
    rgb: RgbGrid = b""


class LocalGraphMessage(Message, kw_only=True):
    """deworldsg/local_graph: the local 3D graph of one frame; frame_id is the world's."""

    width: Side
    height: Side
    T_world_camera: Pose
    classes: Names
    predicates: Names
    objects: Annotated[list[LiftedObject], msgspec.Meta(max_length=MAX_OBJECTS)]
    relations: Annotated[list[RelationLogits], msgspec.Meta(max_length=MAX_RELATIONS)]
    drops: Annotated[dict[Name, NonNegative], msgspec.Meta(max_length=MAX_OBJECTS)] = {}
    depth_grid: Union[DepthGridState, None] = None
    embedding_model: Model = msgspec.UNSET


class PairEvidence(msgspec.Struct):
    """A geometric neighbour pair (Eq. 8), with the world model's prediction if there is one."""

    subject: Annotated[Row, msgspec.Meta(description="row in the local graph")]
    object: Annotated[Row, msgspec.Meta(description="row in the local graph, another one")]
    subject_class: Annotated[int, msgspec.Meta(ge=0, lt=MAX_NAMES, description="index in classes")]
    object_class: Annotated[int, msgspec.Meta(ge=0, lt=MAX_NAMES, description="index in classes")]
    geo_cost: Annotated[float, msgspec.Meta(ge=0.0, le=MAX_COST)]
    prediction: Distribution = []


class RelationEvidenceMessage(Message, kw_only=True):
    """deworldsg/relation_evidence: pairs of the local graph with the same stamp."""

    classes: Names
    predicates: Names
    source: Name
    pairs: Annotated[list[PairEvidence], msgspec.Meta(max_length=MAX_PAIRS)]


class Belief(msgspec.Struct, frozen=True, gc=False):
    """A label with its probability."""

    label: Name
    probability: Probability


class GravityBox(msgspec.Struct, frozen=True, gc=False):
    """A box around an object with one axis along `up`; points far from the others are left out."""

    center_m: Vector3
    size_m: Size3
    orientation_xyzw: Annotated[
        list[UnitPart],
        msgspec.Meta(min_length=4, max_length=4, description="axes of the box to world, unit"),
    ]
    at_least: Annotated[
        Union[Annotated[list[bool], msgspec.Meta(min_length=3, max_length=3)], msgspec.UnsetType],
        msgspec.Meta(
            description="sides of size_m that no view shows to their end: the object may be "
            "longer; absent = none, or not known"
        ),
    ] = msgspec.UNSET


class NodeState(msgspec.Struct, frozen=True, gc=False):
    """One object of the global graph."""

    id: Annotated[NodeId, msgspec.Meta(description="stable, never reused")]
    label: Name
    classes: Annotated[
        list[Belief],
        msgspec.Meta(max_length=MAX_NAMES, description="most probable first, top k"),
    ]
    mean_m: Vector3
    covariance_m2: Matrix3
    observations: Positive
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
    surface_points_m: Annotated[
        Union[Annotated[list[Vector3], msgspec.Meta(max_length=MAX_POINTS)], msgspec.UnsetType],
        msgspec.Meta(description="of version 1"),
    ] = msgspec.UNSET
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
        Union[Annotated[bytes, msgspec.Meta(max_length=6 * MAX_POINTS)], msgspec.UnsetType],
        msgspec.Meta(
            description="points of the surface relative to mean_m: x y z of each, int16 "
            "little-endian, millimetres, base64; replaces surface_points_m"
        ),
    ] = msgspec.UNSET
    label_provenance: Annotated[
        Union[Literal["operator"], msgspec.UnsetType],
        msgspec.Meta(description="operator = set by hand; absent = from the frames"),
    ] = msgspec.UNSET
    colour_lab: Colour = msgspec.UNSET
    named: Annotated[
        bool, msgspec.Meta(description="false = no class is probable enough: label is object")
    ] = True


class HiddenNode(msgspec.Struct, frozen=True):
    """An object that was detected and is not in the graph, with the reason."""

    label: Name
    mean_m: Vector3
    existence: Probability
    observations: Positive
    reason: Annotated[str, msgspec.Meta(max_length=MAX_REASON_CHARACTERS)]


Provenance = Literal["visual", "prior", "fused"]
Measured = Annotated[
    Union[Vector3, msgspec.UnsetType],
    msgspec.Meta(
        description="horizontal gap; bottom of subject above top of object, and the opposite"
    ),
]


class EdgeState(msgspec.Struct, frozen=True, gc=False):
    """One directed edge of the global graph."""

    subject: NodeId
    object: NodeId
    predicate: Annotated[Name, msgspec.Meta(description="the most probable one")]
    probability: Annotated[
        Probability,
        msgspec.Meta(
            description="that this relation holds at all; with edge_belief paper or all_pairs: "
            "that it is this one, if any"
        ),
    ]
    predicates: Annotated[
        list[Belief],
        msgspec.Meta(
            max_length=MAX_NAMES,
            description="most probable first, top k; the probabilities of all predicates sum to "
            "at most 1, and the rest is the probability of no relation",
        ),
    ]
    provenance: Annotated[
        Provenance,
        msgspec.Meta(description="visual = frames, prior = world model, fused = both"),
    ]
    entropy_nats: Annotated[
        float, msgspec.Meta(ge=0.0, description="of the visual distribution (uniform if none)")
    ]
    observations: Annotated[NonNegative, msgspec.Meta(description="frames with visual evidence")]
    remainder: Annotated[
        Union[Probability, msgspec.UnsetType],
        msgspec.Meta(description="probability of all predicates that are not listed"),
    ] = msgspec.UNSET
    mutual: Annotated[
        Union[bool, msgspec.UnsetType],
        msgspec.Meta(description="true = the same holds from object to subject; sent once a pair"),
    ] = msgspec.UNSET
    shown: Annotated[
        Union[NonNegative, msgspec.UnsetType],
        msgspec.Meta(description="frames that showed both objects, when this was computed"),
    ] = msgspec.UNSET
    measured_m: Measured = msgspec.UNSET


class Doorway(msgspec.Struct, frozen=True):
    """A passage from one room to another."""

    to: Annotated[NodeId, msgspec.Meta(description="id of the other room")]
    position_m: Vector3
    width_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)]


class RoomObject(msgspec.Struct, frozen=True):
    """An object of a room, with the probability that it is in it."""

    id: NodeId
    probability: Probability


class RoomState(msgspec.Struct, frozen=True):
    """A room: a part of the free space that walls and doorways bound."""

    id: Annotated[NodeId, msgspec.Meta(description="of rooms, not of objects; stable")]
    label: Annotated[Name, msgspec.Meta(description="room, if no kind is probable enough")]
    kinds: Annotated[
        list[Belief], msgspec.Meta(max_length=MAX_NAMES, description="most probable first")
    ]
    storey: Annotated[NonNegative, msgspec.Meta(description="row in storeys_m")]
    outline_m: Annotated[
        list[Vector3], msgspec.Meta(max_length=MAX_POINTS, description="on its floor, in order")
    ]
    area_m2: Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
    doorways: list[Doorway]
    objects: list[RoomObject]
    named: Annotated[bool, msgspec.Meta(description="false = the label is room")] = True
    label_provenance: Annotated[
        Union[Literal["operator"], msgspec.UnsetType],
        msgspec.Meta(description="operator = named by hand; absent = by what it contains"),
    ] = msgspec.UNSET


Rooms = Annotated[
    Union[Annotated[list[RoomState], msgspec.Meta(max_length=MAX_ROOMS)], msgspec.UnsetType],
    msgspec.Meta(description="all rooms, some seconds old; absent = unchanged, or not known"),
]
Storeys = Annotated[
    Union[Annotated[list[Height], msgspec.Meta(max_length=MAX_ROOMS)], msgspec.UnsetType],
    msgspec.Meta(description="heights of the floors along up, the lowest first; with rooms"),
]
Up = Annotated[
    Union[Annotated[list[UnitPart], msgspec.Meta(min_length=3, max_length=3)], msgspec.UnsetType],
    msgspec.Meta(description="unit vector against gravity in the world frame"),
]
# Sequence numbers start again with each session.
Session = Annotated[
    Union[Name, msgspec.UnsetType],
    msgspec.Meta(description="random id of this run of graph_node; absent = not published live"),
]


class SceneGraphMessage(Message, kw_only=True):
    """/scene_graph: the whole graph after the update with this sequence number."""

    session: Session = msgspec.UNSET
    sequence: NonNegative
    nodes: list[NodeState]
    edges: list[EdgeState]
    up: Up = msgspec.UNSET
    hidden: Annotated[
        Union[list[HiddenNode], msgspec.UnsetType],
        msgspec.Meta(description="in saved files only"),
    ] = msgspec.UNSET
    rooms: Rooms = msgspec.UNSET
    storeys_m: Storeys = msgspec.UNSET


class RemovedNode(msgspec.Struct, frozen=True):
    """A removed node; after a merge, with the node that replaces it."""

    id: NodeId
    merged_into: Union[NodeId, None] = None


class RemovedEdge(msgspec.Struct, frozen=True):
    """A removed edge."""

    subject: NodeId
    object: NodeId


class Association(msgspec.Struct, frozen=True):
    """Which node each object of a frame's local graph became, row by row."""

    stamp: Stamp
    nodes: Annotated[list[NonNegative], msgspec.Meta(max_length=MAX_OBJECTS)]


class SceneGraphUpdateMessage(Message, kw_only=True):
    """/scene_graph/updates: the changes between sequence - 1 and sequence.

    Apply removals first. Then replace each given node and edge.
    """

    session: Session = msgspec.UNSET
    sequence: Positive
    since: Annotated[
        Union[NonNegative, msgspec.UnsetType],
        msgspec.Meta(
            description="the changes begin after this number; 0 = the whole graph; absent = "
            "sequence - 1. Only between the robots of a fleet"
        ),
    ] = msgspec.UNSET
    removed_nodes: list[RemovedNode]
    removed_edges: list[RemovedEdge]
    nodes: list[NodeState]
    edges: list[EdgeState]
    associations: list[Association]
    up: Up = msgspec.UNSET
    rooms: Rooms = msgspec.UNSET
    storeys_m: Storeys = msgspec.UNSET


class NodeEmbedding(msgspec.Struct, frozen=True, gc=False):
    """What an object looks like, from all viewpoints."""

    id: NodeId
    vector: Vector16


class EmbeddingsMessage(Message, kw_only=True):
    """deworldsg/embeddings: embeddings of objects of the graph; frame_id is the world's.

    The first message to a new subscriber is whole. Others have what has changed since the last one;
    a lost one leaves older vectors.
    """

    session: Session = msgspec.UNSET
    whole: Annotated[bool, msgspec.Meta(description="replaces all that came before")]
    model: Name
    nodes: list[NodeEmbedding]
    removed: Annotated[list[NodeId], msgspec.Meta(description="objects that have none any more")]


MESSAGES: dict[str, type[Message]] = {
    "detections": DetectionsMessage,
    "frame_graph": FrameGraphMessage,
    "local_graph": LocalGraphMessage,
    "relation_evidence": RelationEvidenceMessage,
    "scene_graph": SceneGraphMessage,
    "scene_graph_updates": SceneGraphUpdateMessage,
    "embeddings": EmbeddingsMessage,
}

M = TypeVar("M", bound=Message)


@cache
def schema_of(kind: type[Message]) -> Schema:
    """The schema header of messages of this type."""
    name = next(name for name, known in MESSAGES.items() if known is kind)
    return Schema(name, VERSIONS.get(name, VERSION))


def encode(message: Message) -> str:
    """JSON text of a message."""
    return msgspec.json.encode(message).decode()


def max_bytes(kind: type[Message]) -> int:
    """Size of the largest message of this type that is read."""
    graphs = SceneGraphMessage, SceneGraphUpdateMessage, EmbeddingsMessage
    return MAX_GRAPH_BYTES if kind in graphs else MAX_FRAME_BYTES


def decode(text: Union[str, bytes], kind: type[M], most_bytes: Optional[int] = None) -> M:
    """Read and validate a message.

    Args:
        text: JSON.
        kind: type of the message.
        most_bytes: largest size that is read; None = `max_bytes`, the limit of the topics.

    Raises:
        RefusedInput: ``invalid_message`` if the text does not fit the schema, ``message_too_large``
            if it is longer than that, ``unknown_schema`` if it is another message or of a
            later version, ``invalid_frame_id``.
    """
    limit = max_bytes(kind) if most_bytes is None else most_bytes
    if len(text) > limit:
        seen = f"{kind.__name__} of {len(text)} bytes"
        raise RefusedInput("message_too_large", f"{seen}: expected at most {limit}")
    try:
        message = msgspec.json.decode(text, type=kind)
    # UnicodeError: text that is no UTF-8. RecursionError: nested deeper than the interpreter.
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise RefusedInput("invalid_message", f"{kind.__name__}: {error}") from error
    known, found = schema_of(kind), message.schema
    if found.name != known.name or found.version > known.version:
        raise RefusedInput(
            "unknown_schema",
            f"message is {found.name!r} version {found.version}: expected {known.name} version "
            f"{known.version} or older",
        )
    checked_frame_id(message.frame_id)
    try:
        if isinstance(message, EmbeddingsMessage):
            check_labels([message.model])
            _check_once("node", [node.id for node in message.nodes])
        elif isinstance(message, (SceneGraphMessage, SceneGraphUpdateMessage)):
            _check_graph(message)
    except ValueError as error:
        raise RefusedInput("invalid_message", f"{kind.__name__}: {error}") from error
    return message


def _check_graph(message: Union[SceneGraphMessage, SceneGraphUpdateMessage]) -> None:
    """Check text, unit lengths and ids of a graph, which no schema can. Raises ValueError."""
    nodes, edges = message.nodes, message.edges
    labels = {node.label for node in nodes} | {edge.predicate for edge in edges}
    listed = [node.classes for node in nodes] + [edge.predicates for edge in edges]
    labels.update(belief.label for beliefs in listed for belief in beliefs)
    if isinstance(message, SceneGraphMessage) and isinstance(message.hidden, list):
        labels.update(text for node in message.hidden for text in (node.label, node.reason))
    rooms = message.rooms if isinstance(message.rooms, list) else []
    labels.update(name for room in rooms for name in (room.label, *(k.label for k in room.kinds)))
    _check_once("room", [room.id for room in rooms])
    check_labels(sorted(labels))
    if isinstance(message.up, list):
        _check_unit("up", message.up)
    for node in nodes:
        if isinstance(node.box, GravityBox):
            _check_unit(f"box orientation of node {node.id}", node.box.orientation_xyzw)
    _check_once("node", [node.id for node in nodes])
    ends = [(edge.subject, edge.object) for edge in edges]
    _check_once("edge", ends)
    for subject, object_ in ends:
        if subject == object_:
            raise ValueError(f"an edge connects node {subject} with itself")


def _check_unit(name: str, values: list[float]) -> None:
    squared = sum([value * value for value in values])
    if not 0.98 <= squared <= 1.02:
        raise ValueError(f"{name} is {values}: expected length 1, its square is {squared:.4g}")


def _check_once(name: str, items: list[Any]) -> None:
    if len(set(items)) < len(items):
        raise ValueError(f"{name} {Counter(items).most_common(1)[0][0]} is there twice")
