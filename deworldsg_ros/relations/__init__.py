"""Stage d: neighbour pairs (Eq. 8), clips, world models, evidence and fusion (Eq. 9-10)."""

from deworldsg_ros.relations.clip_policy import ClipPolicy
from deworldsg_ros.relations.clip_queue import ClipQueue
from deworldsg_ros.relations.clips import FrameBuffer, QueuedClip, crop_clip, union_box
from deworldsg_ros.relations.edge_beliefs import EdgeBeliefs
from deworldsg_ros.relations.evidence import (
    FusedEdges,
    entropy_nats,
    fuse_distributions,
    fuse_edges,
    visual_distribution,
)
from deworldsg_ros.relations.graph_view import GraphView, LiveGraph, NodeView, PublishedGraph
from deworldsg_ros.relations.pairing import geometric_costs, neighbour_pairs
from deworldsg_ros.relations.prior import ClassPairPrior
from deworldsg_ros.relations.registry import WORLD_MODELS, build_world_model
from deworldsg_ros.relations.stage import RelationCounters, RelationReasoner
from deworldsg_ros.relations.worker import EvidenceWorker
from deworldsg_ros.relations.world_model import ClipRequest, PairContext, WorldModel

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
