"""The server for Foxglove, with a WebSocket client."""

from __future__ import annotations

import json
import struct
import time
from contextlib import closing

import msgspec
import numpy as np
import pytest
from support.view import make_edge, make_graph, make_node

pytest.importorskip("foxglove", reason="needs foxglove-sdk")
client_module = pytest.importorskip("websockets.sync.client", reason="needs websockets")

from support.reference_updates import diff  # noqa: E402

from deworldsg_ros.view.live import foxglove as module  # noqa: E402
from deworldsg_ros.view.live.camera import CameraView  # noqa: E402

LIMIT_S = 30.0


class Client:
    """A client that subscribes to everything, and keeps the messages of each topic."""

    def __init__(self, url):
        protocols = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
        self.socket = client_module.connect(url, subprotocols=protocols, max_size=None)
        self.topics = {}
        self.received = {}

    def expect(self, topic, text):
        """Wait until a message of a topic contains a text."""
        end_s = time.monotonic() + LIMIT_S
        while text not in b"".join(self.received.get(topic, [])):
            assert time.monotonic() < end_s, (topic, text, self.received.keys())
            self._take(self.socket.recv(timeout=LIMIT_S))

    def _take(self, message):
        if isinstance(message, bytes):
            if message[0] == 1:  # message data: opcode, subscription, time, payload
                (subscription,) = struct.unpack_from("<I", message, 1)
                self.received.setdefault(self.topics[subscription], []).append(message[13:])
            return
        content = json.loads(message)
        for channel in content.get("channels", []) if content["op"] == "advertise" else []:
            self.topics[channel["id"]] = channel["topic"]
            subscription = {"id": channel["id"], "channelId": channel["id"]}
            self.socket.send(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))


@pytest.fixture()
def server():
    with closing(module.FoxgloveServer("127.0.0.1", 0)) as made:
        yield made


def graph():
    nodes = [make_node(1, "dining table"), make_node(2, "cup", (0, 0, 1)), make_node(3, "vase")]
    return make_graph(nodes, [make_edge(2, 1, "on"), make_edge(2, 3, "near")])


def test_a_late_client_gets_the_whole_graph_and_then_the_updates(server):
    server.reset(graph())
    with closing(Client(server.url)) as client, closing(client.socket):
        client.close = lambda: None
        client.expect(module.OBJECTS, b"cup 2")
        client.expect(module.RELATIONS, b"relation 2 1")
        client.expect(module.NEAR, b"relation 2 3")
        before = graph()
        nodes = [before.nodes[0], make_node(2, "teapot", (0, 0, 1)), before.nodes[2]]
        after = msgspec.structs.replace(make_graph(nodes, before.edges), sequence=2)
        assert server.apply(diff(before, after))
        client.expect(module.OBJECTS, b"teapot 2")
        server.look(CameraView(1, np.eye(4), np.zeros((48, 64, 3), np.uint8)))
        client.expect(module.IMAGE, b"jpeg")
        client.expect(module.TRANSFORMS, module.CAMERA_FRAME.encode())


def test_only_this_machine_can_connect_unless_asked(server):
    assert server.url.startswith("ws://127.0.0.1:")
