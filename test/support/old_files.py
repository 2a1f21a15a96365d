"""Arrays of graphs and maps as earlier releases wrote them."""

import json

import numpy as np

from deworldsg_ros.base.array_file import Arrays


def version_1(arrays: Arrays, *, votes: bool = True) -> Arrays:
    """Version 1 had revisions, as the last column of edges and the middle one of votes.

    Its first files had no votes, and no probabilities of existence.
    """
    header = {**json.loads(arrays["header"].tobytes()), "version": 1, "revision": 99}
    edges, known = arrays["edge_counts"], arrays["vote_known"]
    old = {
        **arrays,
        "header": np.frombuffer(json.dumps(header).encode(), np.uint8),
        "revisions": np.arange(len(arrays["ids"])),
        "edge_counts": np.column_stack([edges, np.arange(len(edges))]),
        "vote_known": np.insert(known, 1, np.arange(len(known)), axis=1),
    }
    if not votes:
        for name in ("vote_pairs", "vote_known", "vote_counts", "existence"):
            del old[name]
    return old
