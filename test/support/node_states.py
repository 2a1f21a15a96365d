"""The messages of the nodes of a graph, as a publication makes them."""

from weakref import WeakKeyDictionary

from deworldsg_ros.graph.graph import GlobalGraph
from deworldsg_ros.graph.messages import NodeStates
from deworldsg_ros.wire import messages as wire

_made: WeakKeyDictionary[GlobalGraph, dict[int, NodeStates]] = WeakKeyDictionary()


def node_states(
    graph: GlobalGraph, top_k: int, with_points: bool = False
) -> dict[int, wire.NodeState]:
    """Messages of the confirmed nodes by ascending id.

    Messages without points of nodes that did not change since the last call are the same objects.
    """
    of_graph = _made.setdefault(graph, {})
    if top_k not in of_graph:
        of_graph[top_k] = NodeStates(graph, top_k, graph.even_gaussians)
    states = of_graph[top_k]
    states.refresh()
    known = dict(sorted(states.states.items()))
    if not with_points:
        return known
    return {node_id: states.with_points(state) for node_id, state in known.items()}
