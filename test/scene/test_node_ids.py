"""Removed ids are forgotten when nobody can ask for them."""

from __future__ import annotations

import numpy as np

from deworldsg_ros.graph.nodes import PRUNE_ABOVE, NodeIds

FRAMES = 20


def test_removed_ids_are_forgotten_and_those_of_remembered_frames_are_not():
    random = np.random.default_rng(0)
    live: set[int] = set()
    ids, everything = NodeIds(live, FRAMES), NodeIds(live, 10**9)
    sizes = []
    for stamp in range(3000):
        rows = [ids.take() for _ in range(10)]
        live.update(rows)
        for node_id in random.permutation(sorted(live))[:-5].tolist():
            live.discard(node_id)
            successor = int(random.choice(sorted(live)))
            for one in (ids, everything):
                one.retire(node_id, successor)
        for one in (ids, everything):
            one.remember_frame(stamp, rows)
            one.take_removals()
        for known in range(max(0, stamp - FRAMES + 1), stamp + 1):
            assert ids.nodes_of_frame(known) == everything.nodes_of_frame(known)
        sizes.append(len(ids.state().successors))
    assert len(everything.state().successors) == 29_995
    assert max(sizes) <= PRUNE_ABOVE + 10


def test_a_new_merge_of_a_node_that_no_remembered_frame_shows_is_not_forgotten():
    live = {1, 2}
    ids = NodeIds(live, FRAMES)
    for node_id in range(3, PRUNE_ABOVE + 3):
        ids.retire(node_id, 0)
    ids.retire(1, 2)
    live.discard(1)
    ids.take_removals()
    ids.remember_frame(0, [2])
    assert len(ids.state().successors) < PRUNE_ABOVE
    assert ids.resolve(1) == 2
