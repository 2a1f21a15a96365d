"""Translation of detector labels to the classes of a data set.

The protocol scores classes of the data set. A label that is a class stays. Other labels (of COCO)
are translated by the data set's own mapping, else by the synonyms below. A label without a
translation stays, and its probability counts for no class.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene import wire

# COCO classes to labels or classes of the data sets, the first known one counts.
SYNONYMS: dict[str, tuple[str, ...]] = {
    "apple": ("fruit",),
    "bicycle": ("bike",),
    "cell phone": ("phone",),
    "couch": ("sofa",),
    "dining table": ("table",),
    "keyboard": ("computer-keyboard",),
    "oven": ("major-appliance",),
    "potted plant": ("indoor-plant", "plant"),
    "suitcase": ("bag",),
    "tv": ("tv-screen", "tv"),
    "wine glass": ("glass",),
}


def translation(annotations: Annotations) -> dict[str, str]:
    """Class by label, for labels that are not classes themselves."""
    classes = set(annotations.vocabulary.classes)
    known = {label: name for label, name in annotations.class_of_label.items() if name in classes}
    for label, names in SYNONYMS.items():
        for name in (label, *names):
            found = name if name in classes else known.get(name)
            if found is not None:
                known.setdefault(label, found)
    return {label: name for label, name in known.items() if label not in classes}


def translate(graph: wire.SceneGraphMessage, annotations: Annotations) -> wire.SceneGraphMessage:
    """The graph with classes of the data set; probabilities of labels of one class are added.

    Mutual edges are in both directions, as in the ground truth.
    """
    if any(edge.mutual is True for edge in graph.edges):
        graph = msgspec.structs.replace(graph, edges=_both_directions(graph.edges))
    names = translation(annotations)
    if not any(belief.label in names for node in graph.nodes for belief in node.classes):
        return graph
    nodes = []
    for node in graph.nodes:
        sums: dict[str, float] = {}
        for belief in node.classes:
            label = names.get(belief.label, belief.label)
            sums[label] = sums.get(label, 0.0) + belief.probability
        # A stable sort: labels with equal probability keep their order.
        beliefs = [
            wire.Belief(label, min(probability, 1.0))
            for label, probability in sorted(sums.items(), key=lambda item: -item[1])
        ]
        label = beliefs[0].label if beliefs else node.label
        nodes.append(msgspec.structs.replace(node, classes=beliefs, label=label))
    return msgspec.structs.replace(graph, nodes=nodes)


def _both_directions(edges: Sequence[wire.EdgeState]) -> list[wire.EdgeState]:
    swapped = [
        msgspec.structs.replace(edge, subject=edge.object, object=edge.subject)
        for edge in edges
        if edge.mutual is True
    ]
    return sorted([*edges, *swapped], key=lambda edge: (edge.subject, edge.object))
