"""The whole graph is encoded from pieces."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from support.room_nodes import add_node, room, table, thing

from deworldsg_ros.ros import graph_output
from deworldsg_ros.ros.graph_output import PiecewiseEncoder
from deworldsg_ros.wire import messages as wire
from deworldsg_ros.wire.follow import empty_scene_graph


def test_an_empty_graph_has_the_text_of_the_plain_encoder() -> None:
    message = empty_scene_graph("map")
    assert PiecewiseEncoder().encode(message) == wire.encode(message)


def test_the_text_follows_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graph_output, "PIECE_IDS", 2)
    cups = {f"cup {i}": thing("cup", 0.3 * i - 0.6, 0.0, 0.74, 0.08, 0.08, 0.1) for i in range(5)}
    builder, ids = room({"table": table(0.0, 0.0), **cups})
    encoder, rng = PiecewiseEncoder(), np.random.default_rng(0)
    changes = [
        lambda: None,
        lambda: add_node(builder, thing("bowl", 0.0, 0.2, 0.74, 0.2, 0.2, 0.1), rng),
        lambda: builder.graph.move_node(ids["cup 1"], np.eye(4)),
        lambda: builder.graph.remove_node(ids["cup 2"]),
    ]
    for change in changes:
        change()
        builder.update()
        message = builder.snapshot()
        assert message.nodes
        assert encoder.encode(message) == wire.encode(message)
    assert message.edges


def test_unchanged_pieces_are_not_encoded_again(monkeypatch: pytest.MonkeyPatch) -> None:
    builder, _ = room({"table": table(0.0, 0.0)})
    builder.update()
    encoder = PiecewiseEncoder()
    encoder.encode(builder.snapshot())
    encoded: list[object] = []
    plain = msgspec.json.encode
    monkeypatch.setattr(
        graph_output.msgspec.json, "encode", lambda item: (encoded.append(item), plain(item))[1]
    )
    message = builder.snapshot()
    encoder.encode(message)
    # The frame of the message only.
    assert [type(item) for item in encoded] == [wire.SceneGraphMessage]
