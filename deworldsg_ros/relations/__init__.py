"""Stage d: neighbour pairs (Eq. 8), clips, world models, evidence and fusion (Eq. 9-10)."""

from deworldsg_ros.relations.beliefs import EdgeBeliefs
from deworldsg_ros.relations.clips import (
    ClipPolicy,
    ClipQueue,
    FrameBuffer,
    GraphView,
    LiveGraph,
    NodeView,
    PublishedGraph,
    QueuedClip,
    crop_clip,
    union_box,
)
from deworldsg_ros.relations.paper import (
    ClassPairPrior,
    FusedEdges,
    entropy_nats,
    fuse_distributions,
    fuse_edges,
    geometric_costs,
    neighbour_pairs,
    visual_distribution,
)
from deworldsg_ros.relations.stage import (
    WORLD_MODELS,
    EvidenceWorker,
    RelationCounters,
    RelationReasoner,
    build_world_model,
)
from deworldsg_ros.relations.world_model import (
    ClipRequest,
    PairContext,
    WorldModel,
)

__all__ = [
    "WORLD_MODELS",
    "ClassPairPrior",
    "ClipPolicy",
    "ClipQueue",
    "ClipRequest",
    "EdgeBeliefs",
    "EvidenceWorker",
    "FrameBuffer",
    "FusedEdges",
    "GraphView",
    "LiveGraph",
    "NodeView",
    "PairContext",
    "PublishedGraph",
    "QueuedClip",
    "RelationCounters",
    "RelationReasoner",
    "WorldModel",
    "build_world_model",
    "crop_clip",
    "entropy_nats",
    "fuse_distributions",
    "fuse_edges",
    "geometric_costs",
    "neighbour_pairs",
    "union_box",
    "visual_distribution",
]
