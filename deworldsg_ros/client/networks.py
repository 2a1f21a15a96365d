"""The graph as a networkx graph."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from deworldsg_ros.client.errors import ClientError
from deworldsg_ros.client.objects import Relation, SceneObject


def to_networkx(objects: Iterable[SceneObject], relations: Iterable[Relation]) -> Any:
    """A networkx.MultiDiGraph: a node for each object id, an edge with the predicate as its key.

    Attributes are numbers and strings only, so that every writer of networkx takes them.

    Raises:
        ClientError: without the package networkx.
    """
    try:
        import networkx
    except ImportError as error:
        raise ClientError("networkx is not installed: pip install networkx") from error
    graph = networkx.MultiDiGraph()
    for item in objects:
        x, y, z = item.position_m
        length, width, height = item.size_m
        graph.add_node(
            item.id,
            label=item.label,
            probability=round(item.probability, 4),
            observations=item.observations,
            x=x,
            y=y,
            z=z,
            length=length,
            width=width,
            height=height,
        )
    for relation in relations:
        graph.add_edge(
            relation.subject.id,
            relation.object.id,
            key=relation.predicate,
            predicate=relation.predicate,
            probability=round(relation.probability, 4),
            provenance=relation.provenance,
            observations=relation.observations,
        )
    return graph
