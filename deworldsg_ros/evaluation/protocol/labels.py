"""Labels of a detector in the words of a data set.

The protocol counts classes of the data set. A detector that was trained on others (COCO) is
translated: a label that is a class stays; else the data set's own mapping from labels to classes
is asked; else the synonyms below. A label without a counterpart stays what it is, and its
probability is on no class.
"""

from __future__ import annotations

import msgspec

from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.scene import wire

# COCO's names to labels that the mappings of the data sets know, or to their classes.
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
    """Class of every label that has one but is none itself."""
    classes = set(annotations.vocabulary.classes)
    known = {label: name for label, name in annotations.class_of_label.items() if name in classes}
    for label, names in SYNONYMS.items():
        for name in (label, *names):
            found = name if name in classes else known.get(name)
            if found is not None:
                known.setdefault(label, found)
    return {label: name for label, name in known.items() if label not in classes}


def translate(graph: wire.SceneGraphMessage, annotations: Annotations) -> wire.SceneGraphMessage:
    """The graph with the class labels of the data set; probabilities of one class are added."""
    names = translation(annotations)
    if not any(belief.label in names for node in graph.nodes for belief in node.classes):
        return graph
    nodes = []
    for node in graph.nodes:
        sums: dict[str, float] = {}
        for belief in node.classes:
            label = names.get(belief.label, belief.label)
            sums[label] = sums.get(label, 0.0) + belief.probability
        # Stable: of equals the one that came first.
        beliefs = [
            wire.Belief(label, min(probability, 1.0))
            for label, probability in sorted(sums.items(), key=lambda item: -item[1])
        ]
        label = beliefs[0].label if beliefs else node.label
        nodes.append(msgspec.structs.replace(node, classes=beliefs, label=label))
    return msgspec.structs.replace(graph, nodes=nodes)
