"""A WebSocket client of the server for Foxglove."""

import json
import struct
import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 30.0


class FoxgloveClient:
    """A client that subscribes to everything, and keeps the messages of each topic."""

    def __init__(self, connect: Callable[..., Any], url: str) -> None:
        protocols = ["foxglove.sdk.v1", "foxglove.websocket.v1"]
        self.socket = connect(url, subprotocols=protocols, max_size=None)
        self.topics: dict[int, str] = {}
        self.received: dict[str, list[bytes]] = {}

    def expect(self, topic: str, text: bytes) -> None:
        end_s = time.monotonic() + LIMIT_S
        while text not in b"".join(self.received.get(topic, [])):
            assert time.monotonic() < end_s, (topic, text, self.received.keys())
            self._take(self.socket.recv(timeout=LIMIT_S))

    def _take(self, message: bytes | str) -> None:
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
